"""Statistics of fits across people: ICC, shareability, piecewise regression, leave-one-subject-out."""

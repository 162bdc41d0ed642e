"""Gates before anything is fitted: what the raw recordings are worth, with a verdict, a figure and a remedy."""

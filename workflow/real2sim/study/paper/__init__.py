"""The paper's tables, figures and claims by their numbers, beside what is found here."""

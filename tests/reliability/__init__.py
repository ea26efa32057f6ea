"""How reliable the estimators' numbers are: random problems, and what is measured on them."""

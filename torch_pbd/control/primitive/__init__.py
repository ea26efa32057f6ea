"""The movement primitive: from recordings to a reproduced motion, to other starts and goals (eq. 16 to 18)."""

"""Movement primitive, eq. (16) to (18): reproduction of recordings and adaptation to other starts and goals."""

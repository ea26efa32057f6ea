"""Guarantees of a schedule: exponential decay, passivity, stiff environments."""

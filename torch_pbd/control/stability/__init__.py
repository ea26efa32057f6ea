"""What is guaranteed of a schedule: exponential decay, passivity, stiff environments."""

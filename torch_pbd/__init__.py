"""Learn how precise people are from demonstrations."""

"""Training of small policies on demonstrations."""

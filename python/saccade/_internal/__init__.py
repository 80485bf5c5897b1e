"""What several packages share: arrays, files, JSON, optional packages, command-line flags."""

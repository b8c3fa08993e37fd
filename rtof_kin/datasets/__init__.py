"""Public datasets that users have obtained themselves, read into this package's types."""

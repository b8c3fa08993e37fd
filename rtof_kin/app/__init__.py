"""The application: people, visits and recordings in a browser on this machine."""

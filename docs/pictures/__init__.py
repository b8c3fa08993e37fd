"""The pictures of README and docs, each made by one module: ``python -m docs.pictures [NAME ...]``."""

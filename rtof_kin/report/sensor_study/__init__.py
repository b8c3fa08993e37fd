"""Which sensors a protocol needs: accuracy of every subset."""

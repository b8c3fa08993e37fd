"""Outputs of estimates: LSL, WebSocket, page."""

"""The wire between node and host, written once: see ``messages.py``."""

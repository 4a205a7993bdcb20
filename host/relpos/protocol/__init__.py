"""The wire between node and host, written once: what is said, and how it becomes bytes."""

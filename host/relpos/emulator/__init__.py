"""The boards and everything around them, on a virtual clock."""

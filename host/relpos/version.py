"""The version, apart from the interface, so that every module can import it."""

__version__ = "0.2.0"

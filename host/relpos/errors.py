"""What a user can cause: the command line turns each into one clear line and exit status 1."""


class RelposError(Exception):
    """Base of every error whose cause lies in the data, the device or the request."""


class DataError(RelposError):
    """A file, a recording or a run directory is not what it should be."""


class DeviceError(RelposError):
    """A port, a radio or a node does not answer as it should."""

"""Public recordings of walks and ranges: where they are, their licences, how to convert them."""

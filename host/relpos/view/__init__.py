"""What a person sees live."""

"""Run directories: how a recording comes in and an estimate goes out."""

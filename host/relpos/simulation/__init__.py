"""Worlds and walkers: physical truth for the emulator, and measurements made directly."""

"""The nodes as devices: what they tell of themselves, their settings, radios and programs."""

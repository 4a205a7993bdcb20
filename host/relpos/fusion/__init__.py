"""From measurements to one picture of the team."""

"""What `relpos doctor` looks at: whether computer and coordinator are fit for a team."""

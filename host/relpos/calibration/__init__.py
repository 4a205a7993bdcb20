"""What a node's sensors and its wearer's steps are wrong by, found from what the node tells."""

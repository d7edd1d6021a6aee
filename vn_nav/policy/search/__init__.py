"""The policy that searches any house with a map: what it sees, its map, its decisions."""

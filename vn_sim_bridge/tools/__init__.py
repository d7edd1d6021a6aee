"""Looking at houses: contact sheets, a walk with the keyboard."""

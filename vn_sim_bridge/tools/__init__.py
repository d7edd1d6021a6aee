"""Looking at scenes: contact sheets, a walk with the keyboard."""

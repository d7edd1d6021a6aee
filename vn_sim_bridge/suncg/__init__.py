"""Houses in SUNCG's format: read, labelled, and written from our own."""

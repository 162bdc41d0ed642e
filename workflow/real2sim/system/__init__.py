"""What is simulated: plant, drive, replay, export of a model."""

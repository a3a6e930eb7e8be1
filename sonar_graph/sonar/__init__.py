"""From polar sonar images to recognised landmarks with identity probabilities."""

"""What several tests use: scenes, made histories, findings; tests import nothing of each other."""

"""Planning on posteriors: goals, actions, A* and a receding horizon; it needs the file alone."""

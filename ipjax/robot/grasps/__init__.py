"""Planning grasps: pairs of opposite surface points, approaches about them, what is in the way, and how safe it is."""

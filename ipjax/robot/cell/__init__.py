"""A robot cell in MuJoCo: a table, an arm with a gripper, things on the table, a camera, and a pick."""

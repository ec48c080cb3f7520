"""Where a camera is mounted on a robot: AX = XB, from images of a board and the poses of the hand."""

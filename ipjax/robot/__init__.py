"""From pose to grasp: grippers, grasps planned on an object's surface, and files of grasps that others read."""

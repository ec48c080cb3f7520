"""Files of grasps: ours, NVIDIA's isaac_grasp and GraspGen's; and the estimates that they are planned from."""

"""What a calibration is read from: images of a board, and files of a robot's poses."""

"""Finding an object in a frame without a mask: proposals of masks, on the host, and what ranks and verifies them."""

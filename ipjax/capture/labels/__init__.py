"""Labels of every frame: which parts of the scene are objects, where each is, its masks and boxes, in BOP's layout."""

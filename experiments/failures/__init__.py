"""Where a network fails: the worst of many pairs with known disparity, drawn."""

"""Reading and writing of datasets of stereo pairs with ground truth."""

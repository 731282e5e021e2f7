"""Reading and writing of datasets: stereo pairs with ground truth."""

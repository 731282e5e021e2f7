"""Opening of pictures: layouts, pairs in folders, and rectification."""

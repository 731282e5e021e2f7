"""The paper's eight sets as this project makes them, and what is in them."""

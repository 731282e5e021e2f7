"""Objects used to compose scenes."""

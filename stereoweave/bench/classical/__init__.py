"""Classical matchers, written from their papers, to compare the networks with.

All three start from the same matching costs (`costs`), so that they differ only in what they make of them.
"""

"""One set for all frames of a shot: the search for it, and the frames that are done with it."""

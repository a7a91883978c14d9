"""What the commands share: arguments and options, the work through the frames of a file, streams, Ctrl-C, and what a
process still says when native code crashes it. Any command may use it; it knows none of them."""

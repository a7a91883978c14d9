"""What a frame is made of, as arrays: the model that every room reads, and geometry of boxes, cameras and film that
needs no ray.

Fields may be added to the model with a default that means what scenes without them meant; records are read by kernels,
so both change together.
"""

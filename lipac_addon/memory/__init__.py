"""Who takes the memory of a render: bytes by mesh, image and instance of an extracted frame, and why each of them
stays."""

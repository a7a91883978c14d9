"""What a render takes, and who takes it: bytes by mesh, image and instance of an extracted frame, and why each of them
stays; whether culling could save anything."""

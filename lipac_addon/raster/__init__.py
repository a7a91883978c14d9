"""What Blender's GPU draws for the hybrid renderer: first hits of its own pass, and EEVEE's passes."""

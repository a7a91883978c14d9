"""Node materials and images -> MATERIAL and TEXTURE records, and how far displacement moves a surface.

A node is added in `nodes` (values) or `converter` (shaders); what is not followed is listed as approximated.
"""

"""What is drawn of results: overlay boxes, and figures in words.

Reads `state` alone; nothing here changes the file.
"""

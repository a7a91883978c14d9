"""Pages that people read: one HTML file each, with its pictures inside, from what commands have written; nothing is
loaded from elsewhere."""

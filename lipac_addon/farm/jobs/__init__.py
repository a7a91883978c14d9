"""A shot as a job: its steps as a graph, and the descriptions of it for those who run them."""

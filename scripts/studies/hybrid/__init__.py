"""What the hybrid renderer shows and costs: measurements, and the tables and plots of docs/results.md made of them."""

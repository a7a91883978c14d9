"""Animated scenes, measured by `lipac bench --only animation`: the parts, and the page that they write."""

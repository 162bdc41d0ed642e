"""A simulated person who walks, and the robot that walks with them."""

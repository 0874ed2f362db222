"""The sensor simulator: a reconstruction answers what a camera or LiDAR would measure, wherever a planner drives."""

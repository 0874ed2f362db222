"""KITTI: raw, odometry, tracking and object layouts."""

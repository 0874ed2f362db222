"""KITTI: raw, odometry, tracking and object layouts."""

LICENCE = "CC BY-NC-SA 3.0 (KITTI: Geiger, Lenz, Stiller, Urtasun; attribution, non-commercial, share-alike)"

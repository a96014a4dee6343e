"""Ground truth for recordings: static flow from a room's point cloud (EuRoC) or from LiDAR scans (KITTI)."""

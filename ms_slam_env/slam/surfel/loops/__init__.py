"""Loop closure of the surfel SLAM."""

"""Dense SLAM with surfels, frame to model (Whelan et al., ElasticFusion, RSS 2015, IJRR 2016)."""

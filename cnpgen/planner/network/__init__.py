"""The neural planner's pure part: features, network, and the control points that it stands for, with gradients."""

"""Plan with a trained model: kinematics and limits evaluated before and after the network."""

"""The articulated body: skeleton, skin, pose and kinematics."""

"""The robot, the strap and the replayed pelvis as one MuJoCo plant."""

"""Browser page to draw strokes, see their covariance, bend the movement and push the robot that follows it."""

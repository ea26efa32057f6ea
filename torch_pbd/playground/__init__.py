"""A page in the browser: draw strokes, see their covariance, bend the movement, push the robot that follows it."""

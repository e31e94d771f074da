"""What the surface reflects, as far as the images of spots tell."""

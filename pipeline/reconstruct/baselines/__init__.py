"""Methods that any better one must beat: the thesis's, a homogeneous dipole, a Lambertian surface."""

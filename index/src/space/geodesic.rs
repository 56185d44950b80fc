//! Shortest paths between states.

use super::Space;

impl Space {
    /// The state the share `t` of the way from `a` to `b` along a shortest path, written to `between` in canonical
    /// form: the segment in `RealVector`, the shorter arc in `SO2`, rotation about a fixed axis in `SO3`, all at once.
    ///
    /// Its distance to `a` is `t` times that of `b`, apart from rounding. With `t` at or below 0 it is `a`, and at or
    /// above 1 it is `b`, to the bit. If two paths are equally short, as between opposite angles, it is always on the
    /// same one.
    ///
    /// ```
    /// use wayfold_index::Space;
    ///
    /// let mut between = [0.0; 3];
    /// Space::se2().interpolate(&[0.0, 0.0, -3.0], &[4.0, 2.0, 3.0], 0.75, &mut between);
    /// assert_eq!(between[..2], [3.0, 1.5]);
    /// assert!(between[2] > 3.0); // across the seam
    /// ```
    ///
    /// # Panics
    /// If a row is shorter than [`Space::coordinates`], or `a` or `b` is not canonical ([`Space::canonicalize`]) and
    /// has no state between.
    pub fn interpolate(&self, a: &[f64], b: &[f64], t: f64, between: &mut [f64]) {
        let row = ..self.coordinates();
        let (a, b, between) = (&a[row], &b[row], &mut between[row]);
        if t >= 1.0 {
            between.copy_from_slice(b);
        } else if t > 0.0 {
            for part in self.parts() {
                let (a, b) = (&a[part.axes()], &b[part.axes()]);
                let between = &mut between[part.axes()];
                part.factor.interpolate(a, b, t, between);
                let canonical = part.factor.canonicalize(between);
                assert!(canonical.is_ok(), "between {a:?} and {b:?} is no state");
            }
        } else {
            between.copy_from_slice(a);
        }
    }
}

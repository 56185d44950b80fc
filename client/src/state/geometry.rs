//! The types of `nalgebra` that are states.

use nalgebra::{
    DVector, Isometry2, Isometry3, Point, Quaternion, SVector, Translation2, Translation3,
    UnitComplex, UnitQuaternion,
};

use super::{FromState, State};
use crate::layout::Coordinate::{self, Angle, Qw, Qx, Qy, Qz, Real};

impl<const N: usize> State for SVector<f64, N> {
    fn write(&self, row: &mut Vec<f64>) {
        row.extend_from_slice(self.as_slice());
    }
}

impl<const N: usize> FromState for SVector<f64, N> {
    fn from_state(row: &[f64]) -> Option<Self> {
        <[f64; N]>::from_state(row).map(Self::from)
    }
}

impl State for DVector<f64> {
    fn write(&self, row: &mut Vec<f64>) {
        row.extend_from_slice(self.as_slice());
    }
}

impl FromState for DVector<f64> {
    fn from_state(row: &[f64]) -> Option<Self> {
        Some(Self::from_row_slice(row))
    }
}

/// The layout of a point.
struct Reals<const N: usize>;

impl<const N: usize> Reals<N> {
    const ROW: [Coordinate; N] = [Real; N];
}

impl<const N: usize> State for Point<f64, N> {
    fn write(&self, row: &mut Vec<f64>) {
        self.coords.write(row);
    }

    fn layout() -> Option<&'static [Coordinate]> {
        Some(&Reals::<N>::ROW)
    }
}

impl<const N: usize> FromState for Point<f64, N> {
    fn from_state(row: &[f64]) -> Option<Self> {
        SVector::from_state(row).map(Self::from)
    }
}

impl State for UnitComplex<f64> {
    fn write(&self, row: &mut Vec<f64>) {
        row.push(self.angle());
    }

    fn layout() -> Option<&'static [Coordinate]> {
        Some(&[Angle])
    }
}

impl FromState for UnitComplex<f64> {
    fn from_state(row: &[f64]) -> Option<Self> {
        <[f64; 1]>::from_state(row).map(|[angle]| Self::new(angle))
    }
}

impl State for UnitQuaternion<f64> {
    fn write(&self, row: &mut Vec<f64>) {
        // Already in the order x, y, z, w.
        row.extend_from_slice(self.coords.as_slice());
    }

    fn layout() -> Option<&'static [Coordinate]> {
        Some(&[Qx, Qy, Qz, Qw])
    }
}

impl FromState for UnitQuaternion<f64> {
    fn from_state(row: &[f64]) -> Option<Self> {
        let [x, y, z, w] = <[f64; 4]>::from_state(row)?;
        // A canonical row is normalised, and stays as it is to the bit.
        Some(Self::new_unchecked(Quaternion::new(w, x, y, z)))
    }
}

impl State for Isometry2<f64> {
    fn write(&self, row: &mut Vec<f64>) {
        self.translation.vector.write(row);
        self.rotation.write(row);
    }

    fn layout() -> Option<&'static [Coordinate]> {
        Some(&[Real, Real, Angle])
    }
}

impl FromState for Isometry2<f64> {
    fn from_state(row: &[f64]) -> Option<Self> {
        let [x, y, angle] = <[f64; 3]>::from_state(row)?;
        Some(Self::from_parts(
            Translation2::new(x, y),
            UnitComplex::new(angle),
        ))
    }
}

impl State for Isometry3<f64> {
    fn write(&self, row: &mut Vec<f64>) {
        self.translation.vector.write(row);
        self.rotation.write(row);
    }

    fn layout() -> Option<&'static [Coordinate]> {
        Some(&[Real, Real, Real, Qx, Qy, Qz, Qw])
    }
}

impl FromState for Isometry3<f64> {
    fn from_state(row: &[f64]) -> Option<Self> {
        let [x, y, z, rotation @ ..] = <[f64; 7]>::from_state(row)?;
        Some(Self::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_state(&rotation)?,
        ))
    }
}

//! The kinds of the numbers of a row, and their names.

use std::f64::consts::TAU;

use wayfold_index::{Factor, Space};

/// The kind of one number of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coordinate {
    /// A coordinate of a real vector.
    Real,
    /// An angle in radians.
    Angle,
    /// A position on a circle whose period is not 2π.
    Arc,
    /// x of a unit quaternion.
    Qx,
    /// y of a unit quaternion.
    Qy,
    /// z of a unit quaternion.
    Qz,
    /// w of a unit quaternion.
    Qw,
}

/// A row's coordinates in words, for a message.
pub(crate) fn describe(row: &[Coordinate]) -> String {
    let words = row.iter().map(|coordinate| match coordinate {
        Coordinate::Real => "real",
        Coordinate::Angle => "angle",
        Coordinate::Arc => "arc",
        Coordinate::Qx => "qx",
        Coordinate::Qy => "qy",
        Coordinate::Qz => "qz",
        Coordinate::Qw => "qw",
    });
    words.collect::<Vec<_>>().join(", ")
}

/// The kind of each number of a state of `space`.
pub(crate) fn coordinates(space: &Space) -> Vec<Coordinate> {
    let mut row = Vec::with_capacity(space.coordinates());
    for factor in factors(space) {
        match factor {
            Factor::RealVector(n) => row.extend(std::iter::repeat_n(Coordinate::Real, n)),
            Factor::SO2 { period: TAU } => row.push(Coordinate::Angle),
            Factor::SO2 { .. } => row.push(Coordinate::Arc),
            Factor::SO3 => row.extend([
                Coordinate::Qx,
                Coordinate::Qy,
                Coordinate::Qz,
                Coordinate::Qw,
            ]),
        }
    }
    row
}

/// A name for each number of a state of `space`, each name once: `x, y, z, qx, qy, qz, qw` for SE(3),
/// `theta0, theta1` for a torus.
///
/// A vector of up to three coordinates has x, y, z, a longer one x0, x1 and so on; an angle is theta, a quaternion qx,
/// qy, qz, qw. If a space has several factors of a kind, the name ends with the factor's number: y1 is the second
/// coordinate of the second vector.
pub fn coordinate_names(space: &Space) -> Vec<String> {
    let vectors = factors(space)
        .filter(|factor| matches!(factor, Factor::RealVector(_)))
        .count();
    let angles = factors(space)
        .filter(|factor| matches!(factor, Factor::SO2 { .. }))
        .count();
    let rotations = factors(space)
        .filter(|factor| matches!(factor, Factor::SO3))
        .count();
    // The number of a factor among those of its kind, if there are several.
    let (mut vector, mut angle, mut rotation) =
        (number(vectors), number(angles), number(rotations));
    let mut names = Vec::with_capacity(space.coordinates());
    for factor in factors(space) {
        match factor {
            Factor::RealVector(n @ ..=3) => {
                let which = vector();
                names.extend(
                    ["x", "y", "z"]
                        .iter()
                        .take(n)
                        .map(|axis| format!("{axis}{which}")),
                );
            }
            Factor::RealVector(n) => {
                let which = vector();
                let separator = if which.is_empty() { "" } else { "_" };
                names.extend((0..n).map(|i| format!("x{which}{separator}{i}")));
            }
            Factor::SO2 { .. } => names.push(format!("theta{}", angle())),
            Factor::SO3 => {
                let which = rotation();
                names.extend(["qx", "qy", "qz", "qw"].map(|part| format!("{part}{which}")));
            }
        }
    }
    names
}

/// Numbers from 0 as text, or an empty text if there is only one.
fn number(of: usize) -> impl FnMut() -> String {
    let mut next = 0;
    move || {
        next += 1;
        if of > 1 {
            (next - 1).to_string()
        } else {
            String::new()
        }
    }
}

fn factors(space: &Space) -> impl Iterator<Item = Factor> {
    space
        .groups()
        .iter()
        .flat_map(|group| &group.terms)
        .map(|term| term.factor)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    fn names(space: &str) -> String {
        coordinate_names(&space.parse().unwrap()).join(" ")
    }

    #[test]
    fn names_are_those_of_the_field() {
        assert_eq!(names("R2*SO2"), "x y theta");
        assert_eq!(names("sum(R3, SO3)"), "x y z qx qy qz qw");
        assert_eq!(names("SO3*R3"), "qx qy qz qw x y z");
        assert_eq!(names("SO2^2"), "theta0 theta1");
        assert_eq!(names("R6"), "x0 x1 x2 x3 x4 x5");
        assert_eq!(names("sum(R1^3)"), "x0 x1 x2");
        assert_eq!(names("R2*R2*SO2"), "x0 y0 x1 y1 theta");
        assert_eq!(names("R4*R1"), "x0_0 x0_1 x0_2 x0_3 x1");
    }

    #[test]
    fn no_name_stands_for_two_coordinates() {
        for space in [
            "(R3*RP3:0.15)^8",
            "R11*R4*R1*SO2^3*SO3",
            "R1^12*R12",
            "R256",
        ] {
            let space: Space = space.parse().unwrap();
            let names = coordinate_names(&space);
            assert_eq!(names.len(), space.coordinates());
            assert_eq!(
                names.iter().collect::<HashSet<_>>().len(),
                names.len(),
                "{space}"
            );
        }
    }

    #[test]
    fn only_a_circle_of_two_pi_holds_angles_in_radians() {
        assert_eq!(
            coordinates(&Space::se2()),
            [Coordinate::Real, Coordinate::Real, Coordinate::Angle]
        );
        assert_eq!(coordinates(&"SO2[1]".parse().unwrap()), [Coordinate::Arc]);
    }
}

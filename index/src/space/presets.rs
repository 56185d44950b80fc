//! Named spaces, accepted in place of a whole space.

use super::{Factor, Group, Space, SpaceError};

/// The names of spaces in other software, and their text.
const PRESETS: [(&str, &str); 4] = [
    // Yershova and LaValle's library MPNN, with the weights of their experiments.
    ("mpnn-se3", "R3*RP3:0.15"),
    // OMPL's SE2StateSpace and SE3StateSpace: compound spaces, which add weighted distances.
    ("ompl-se2", "sum(R2, SO2:0.5)"),
    ("ompl-se3", "sum(R3, SO3)"),
    // OMPL's TorusStateSpace: the root of two squared arcs.
    ("ompl-torus", "SO2^2"),
];

/// A MoveIt joint group of N joints adds the distances of its joints.
const MOVEIT_JOINTS: &str = "moveit-joints-";

/// The preset of this name, if there is one.
pub(super) fn named(name: &str) -> Option<Result<Space, SpaceError>> {
    if let Some((_, text)) = PRESETS.iter().find(|(preset, _)| *preset == name) {
        return Some(text.parse());
    }
    let joints = name.strip_prefix(MOVEIT_JOINTS)?;
    if !joints.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let joints = joints.parse().ok()?;
    if joints > Space::MAX_COORDINATES {
        return Some(Err(SpaceError::TooManyCoordinates));
    }
    let joint = Group {
        weight: 1.0,
        terms: vec![Factor::RealVector(1).into()],
    };
    Some(Space::new(vec![joint; joints]))
}

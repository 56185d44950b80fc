//! The measured spaces, by the names in the tables.

use wayfold_index::Space;

use crate::problem::Problem;

/// A space and the extent of its measurements.
#[derive(Clone, Debug)]
pub struct Setting {
    /// The name in the tables.
    pub name: &'static str,
    /// Its text form, which has the weights.
    pub text: &'static str,
    /// True if `--quick` measures it.
    pub quick: bool,
    /// True if it is measured with a million points too.
    pub million: bool,
    /// True if it is measured with data that is not uniform too.
    pub uneven: bool,
}

const fn setting(name: &'static str, text: &'static str) -> Setting {
    Setting {
        name,
        text,
        quick: false,
        million: false,
        uneven: false,
    }
}

const fn quick(setting: Setting) -> Setting {
    Setting {
        quick: true,
        ..setting
    }
}

const fn million(setting: Setting) -> Setting {
    Setting {
        million: true,
        ..setting
    }
}

const fn uneven(setting: Setting) -> Setting {
    Setting {
        uneven: true,
        ..setting
    }
}

/// All of them, from few dimensions to many.
pub const SETTINGS: [Setting; 13] = [
    uneven(million(quick(setting("R3", "R3")))),
    million(quick(setting("R6", "R6"))),
    uneven(million(setting("R12", "R12"))),
    setting("R30", "R30"),
    million(setting("SO2^3", "SO2^3")),
    uneven(million(setting("SO2^6", "SO2^6"))),
    million(quick(setting("SO3", "SO3"))),
    uneven(million(quick(setting("SE2", "R2*SO2")))),
    uneven(million(quick(setting("SE3", "R3*SO3:0.15")))),
    million(quick(setting("SE3-SUM", "sum(R3, SO3)"))),
    uneven(quick(setting("SE3^2", "(R3*SO3:0.15)^2"))),
    quick(setting("SE3^4", "(R3*SO3:0.15)^4")),
    setting("SE3^8", "(R3*SO3:0.15)^8"),
];

/// Parses the text form of a space.
///
/// # Errors
/// The text describes no space.
pub fn parse(text: &str) -> Result<Space, Problem> {
    text.parse().map_err(|source| Problem::Space {
        text: text.to_owned(),
        source,
    })
}

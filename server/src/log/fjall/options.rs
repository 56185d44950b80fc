//! The settings of a log in a directory.

use serde::Deserialize;

/// The strongest failure that an acknowledged mutation survives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub enum Durability {
    /// A loss of power.
    Fsync,
    /// The end of the server's process, for any cause.
    Os,
    /// An orderly stop of the server.
    None,
}

impl TryFrom<String> for Durability {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        match name.as_str() {
            "fsync" => Ok(Self::Fsync),
            "os" => Ok(Self::Os),
            "none" => Ok(Self::None),
            _ => Err(format!("\"{name}\" is none of \"fsync\", \"os\", \"none\"")),
        }
    }
}

/// How a log is kept in a directory.
#[derive(Clone, Copy, Debug)]
pub struct StoreOptions {
    /// The strongest failure that an acknowledged mutation survives.
    pub durability: Durability,
    /// The memory of the server: the store takes a quarter of it at most.
    pub memory: u64,
    /// True if another journal has the records: this store is then synced at an interval, whatever was acknowledged. Each
    /// batch is written to the operating system at once.
    pub is_copy: bool,
}

impl From<Durability> for StoreOptions {
    fn from(durability: Durability) -> Self {
        Self {
            durability,
            memory: u64::MAX,
            is_copy: false,
        }
    }
}

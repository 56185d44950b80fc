//! The descriptors of the messages.

use std::sync::LazyLock;

use prost::Name;
use prost_reflect::{DescriptorError, DescriptorPool, EnumDescriptor, MessageDescriptor};
use wayfold_proto::v1;

use crate::{service::Error, status::DETAIL_DESCRIPTORS};

static POOL: LazyLock<Result<DescriptorPool, DescriptorError>> = LazyLock::new(|| {
    let mut pool = DescriptorPool::new();
    pool.decode_file_descriptor_set(v1::FILE_DESCRIPTOR_SET)?;
    pool.decode_file_descriptor_set(DETAIL_DESCRIPTORS)?;
    Ok(pool)
});

/// The descriptor of a message.
pub(super) fn message<M: Name>() -> Result<MessageDescriptor, Error> {
    let unknown = |why: String| Error::Internal {
        what: format!("no descriptor of {}: {why}", M::NAME),
    };
    let pool = POOL.as_ref().map_err(|error| unknown(error.to_string()))?;
    let found = pool.get_message_by_name(&M::full_name());
    found.ok_or_else(|| unknown("there is no such message".into()))
}

/// The message that a `google.protobuf.Any` names, if it is one of an error's details.
pub(super) fn detail(type_url: &str) -> Option<MessageDescriptor> {
    let (_, name) = type_url.rsplit_once('/')?;
    POOL.as_ref().ok()?.get_message_by_name(name)
}

/// The prefix of an enumeration's values: `ON_CONFLICT_` for `OnConflict`.
pub(super) fn prefix(descriptor: &EnumDescriptor) -> String {
    let mut prefix = String::new();
    for letter in descriptor.name().chars() {
        if letter.is_ascii_uppercase() && !prefix.is_empty() {
            prefix.push('_');
        }
        prefix.push(letter.to_ascii_uppercase());
    }
    prefix.push('_');
    prefix
}

/// The messages whose JSON form differs from their fields.
pub(super) mod special {
    /// Rows of coordinates.
    pub(crate) const STATES: &str = "wayfold.v1.States";
    /// Columns by state.
    pub(crate) const NEIGHBORS: &str = "wayfold.v1.Neighbors";
    /// Columns, some of them optional.
    pub(crate) const POINTS: &str = "wayfold.v1.Points";
    /// Names of columns.
    pub(crate) const INCLUDE: &str = "wayfold.v1.Include";
    /// The request that names its index itself, as no key does.
    pub(crate) const DELETE_INDEX: &str = "wayfold.v1.DeleteIndexRequest";
    /// A message of any type.
    pub(crate) const ANY: &str = "google.protobuf.Any";
    /// Answers whose JSON merges the fields of `neighbors` with their own.
    pub(crate) const SEARCH_RESPONSES: [&str; 2] =
        ["wayfold.v1.KnnResponse", "wayfold.v1.QueryResponse"];
}

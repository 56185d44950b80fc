//! The `wayfold.v1` protocol: messages, gRPC stubs, conversions to and from the types of `wayfold-index`, and the
//! format of snapshots.
//!
//! The gRPC stubs, and tonic with them, are the feature `grpc`, on by default.

mod neighbors;
pub mod snapshot;
pub mod space;

/// The first id that is too large.
pub const END_OF_IDS: u64 = 1 << 63;

/// Messages, clients and servers of package `wayfold.v1`; every field is documented in `wayfold/v1/*.proto`.
#[expect(clippy::allow_attributes_without_reason, reason = "generated code")]
pub mod v1 {
    include!(concat!(env!("OUT_DIR"), "/wayfold.v1.rs"));

    /// The encoded `google.protobuf.FileDescriptorSet` of the package and its imports, for gRPC reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] =
        include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}

//! The `wayfold.v1` protocol: messages, gRPC stubs, conversions to and from the types of `wayfold-index`, and the format
//! of snapshots.

mod neighbors;
pub mod snapshot;
pub mod space;

/// Messages, clients and servers of package `wayfold.v1`; every field is documented in `wayfold/v1/*.proto`.
#[expect(clippy::allow_attributes_without_reason, reason = "generated code")]
pub mod v1 {
    tonic::include_proto!("wayfold.v1");

    /// The encoded `google.protobuf.FileDescriptorSet` of the package and its imports, for gRPC reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] =
        include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}

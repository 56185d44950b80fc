//! Generates the messages and the gRPC stubs from `wayfold/v1/*.proto`, without `protoc`.

use std::{env, error::Error, fs, path::PathBuf};

const PROTOS: [&str; 5] = [
    "wayfold/v1/space.proto",
    "wayfold/v1/types.proto",
    "wayfold/v1/index_service.proto",
    "wayfold/v1/point_service.proto",
    "wayfold/v1/snapshot.proto",
];

fn main() -> Result<(), Box<dyn Error>> {
    let root = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?);
    println!("cargo:rerun-if-changed={}", root.join("wayfold").display());
    let mut compiler = protox::Compiler::new([&root])?;
    compiler.include_imports(true).include_source_info(true);
    compiler.open_files(PROTOS)?;

    // Reflection serves the whole set, comments included.
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(
        out.join("descriptors.bin"),
        compiler.encode_file_descriptor_set(),
    )?;
    let grpc = env::var_os("CARGO_FEATURE_GRPC").is_some();
    let mut config = tonic_prost_build::Config::new();
    config.enable_type_names();
    tonic_prost_build::configure()
        .build_client(grpc)
        .build_server(grpc)
        .bytes(".wayfold.v1.InsertRequest.payloads")
        .bytes(".wayfold.v1.UpdateRequest.payloads")
        .bytes(".wayfold.v1.WriteRequest.payloads")
        .bytes(".wayfold.v1.Neighbors.payloads")
        .bytes(".wayfold.v1.Points.payloads")
        .bytes(".wayfold.v1.SnapshotPart")
        .compile_fds_with_config(compiler.file_descriptor_set(), config)?;
    Ok(())
}

//! Compiles the peers that are written in C++, for this CPU, and links their libraries. With `PEERS_CPP=off` it does
//! neither, so that the Rust code can be checked where they are not installed. `NIGH` names a checkout of nigh, which no
//! package has; without it the build has no nigh.

use std::{
    env, fs,
    path::{Path, PathBuf},
};

fn main() {
    println!("cargo::rerun-if-changed=cpp");
    println!("cargo::rerun-if-env-changed=PEERS_PORTABLE");
    println!("cargo::rerun-if-env-changed=PEERS_CPP");
    println!("cargo::rerun-if-env-changed=NIGH");
    println!("cargo::rustc-check-cfg=cfg(nigh)");
    if env::var("PEERS_CPP").is_ok_and(|cpp| cpp == "off") {
        return;
    }
    let mut build = cc::Build::new();
    build
        .cpp(true)
        .std("c++17")
        .opt_level(3)
        .define("NDEBUG", None)
        .force_frame_pointer(false)
        // nanoflann's forest copies empty trees, which causes this warning.
        .flag_if_supported("-Wno-maybe-uninitialized")
        .files(["peer", "nanoflann", "ann", "gnat"].map(|name| format!("cpp/{name}.cpp")))
        .flag("-isystem")
        .flag("/usr/include/eigen3");
    // A portable build measures only the loss of our index, not the peers.
    if env::var_os("PEERS_PORTABLE").is_none() {
        build.flag("-march=native");
    }
    for folder in ompl_headers() {
        build.flag("-isystem").flag(folder);
    }
    if let Some(checkout) = env::var_os("NIGH") {
        let headers = Path::new(&checkout).join("src");
        if !headers.join("nigh/kdtree_batch.hpp").exists() {
            println!(
                "cargo::error=NIGH={} is no checkout of nigh",
                checkout.display()
            );
            return;
        }
        println!("cargo::rustc-cfg=nigh");
        println!("cargo::rerun-if-changed={}", headers.display());
        // nigh moves matrices before it sets them, which causes this warning.
        build.flag_if_supported("-Wno-uninitialized");
        build.file("cpp/nigh.cpp").flag("-isystem").flag(headers);
    }
    build.compile("peers");
    println!("cargo::rustc-link-lib=ompl");
    println!("cargo::rustc-link-lib=ann");
}

/// Debian's folder of the headers is named by their version.
fn ompl_headers() -> Vec<PathBuf> {
    let folders = fs::read_dir("/usr/include").into_iter().flatten().flatten();
    let is_ompl = |path: &PathBuf| path.join("ompl/config.h").exists();
    folders.map(|entry| entry.path()).filter(is_ompl).collect()
}

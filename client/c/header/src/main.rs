//! Writes `wayfold.h` from the source of `wayfold-c`: `wayfold-c-header PATH [--no-net]`.

use std::{env, path::Path, process::ExitCode};

use cbindgen::{Builder, Config, Language, Style};

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let (path, has_net) = match &arguments[..] {
        [path] => (path, true),
        [path, option] if option == "--no-net" => (path, false),
        _ => {
            eprintln!("usage: wayfold-c-header PATH [--no-net]");
            return ExitCode::from(2);
        }
    };
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../src");
    let mut config = Config {
        language: Language::C,
        cpp_compat: true,
        style: Style::Both,
        include_guard: Some("WAYFOLD_H".to_owned()),
        sys_includes: ["stddef.h", "stdint.h", "stdbool.h"].map(str::to_owned).to_vec(),
        no_includes: true,
        usize_is_size_t: true,
        documentation: true,
        header: Some(
            "// Exact nearest-neighbour indices for motion planners. Generated from client/c/src: do not edit.".to_owned(),
        ),
        ..Config::default()
    };
    config.enumeration.prefix_with_name = true;
    config.enumeration.rename_variants = cbindgen::RenameRule::ScreamingSnakeCase;
    let names = [
        ("Code", "wayfold_code"),
        ("WayfoldIndex", "wayfold_index"),
        ("WayfoldPoints", "wayfold_points"),
        ("WayfoldPayloads", "wayfold_payloads"),
        ("WayfoldResults", "wayfold_results"),
        ("WayfoldAnswer", "wayfold_answer"),
        ("WayfoldAnswers", "wayfold_answers"),
        ("WayfoldSearch", "wayfold_search"),
        ("WayfoldPoint", "wayfold_point"),
        ("WayfoldServer", "wayfold_server"),
        ("WayfoldStatus", "wayfold_status"),
        ("WayfoldUnsent", "wayfold_unsent"),
        ("WayfoldUnsentKind", "wayfold_unsent_kind"),
        ("WayfoldUnsentWrite", "wayfold_unsent_write"),
    ];
    for (rust, c) in names {
        config.export.rename.insert(rust.to_owned(), c.to_owned());
    }
    let mut builder = Builder::new().with_config(config);
    const NET_FILES: [&str; 3] = ["abi/server.rs", "abi/connection.rs", "abi/meanwhile.rs"];
    const FILES: [&str; 6] = [
        "code.rs",
        "options.rs",
        "abi/index.rs",
        "abi/write.rs",
        "abi/search.rs",
        "abi/points.rs",
    ];
    let net_files = if has_net { &NET_FILES[..] } else { &[] };
    for file in FILES.iter().chain(net_files) {
        builder = builder.with_src(source.join(file));
    }
    match builder.generate() {
        Ok(bindings) => {
            bindings.write_to_file(path);
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("wayfold-c-header: {error}");
            ExitCode::FAILURE
        }
    }
}

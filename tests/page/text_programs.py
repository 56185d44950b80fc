"""The texts of the probe as programs: compiled and run as a user would."""

import contextlib
import os
import pathlib
import subprocess
import tempfile

# Compilers are slow beside other work.
MAX_BUILD_S = 600


class Builds:
    """The packages that client/python/check and client/cpp/check have left in a target directory, and the library for Rust."""

    def __init__(self, target):
        self.target = target.resolve()
        # Cargo keeps one for each set of features that was asked for; each has the network.
        self.rlib = max(self.target.glob("debug/deps/libwayfold-*.rlib"), key=lambda file: file.stat().st_mtime)

    @contextlib.contextmanager
    def command(self, language, text):
        """The command that runs a text of a language, while its files stand."""
        with tempfile.TemporaryDirectory() as directory:
            made = {"Rust": self.rust, "Python": self.python, "C++": self.cpp}[language]
            yield made(pathlib.Path(directory), text)

    def python(self, _directory, text):
        return [self.target / "python/empty/bin/python", "-c", text]

    def rust(self, directory, text):
        """Its statements stand in a function that may fail, as the docs say."""
        source, program = directory / "main.rs", directory / "main"
        source.write_text(f"fn main() -> Result<(), Box<dyn std::error::Error>> {{\n{text}\nOk(())\n}}\n")
        run(["rustc", "--edition=2024", "-Dwarnings", "-o", program, "--extern", f"wayfold={self.rlib}",
             "-L", f"dependency={self.target / 'debug/deps'}", source])
        return [program]

    def cpp(self, directory, text):
        """A program whose includes stand first, and whose statements stand in `main`."""
        source, program = directory / "main.cpp", directory / "main"
        lines = text.splitlines()
        included = [line for line in lines if line.startswith("#include")]
        statements = [line for line in lines if not line.startswith("#include")]
        source.write_text("\n".join([*included, "int main() {", "std::cout.precision(17);", *statements, "}"]))
        prefix = self.target / "cpp-check/prefix"
        run(["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{prefix}/include", source, "-o", program,
             f"-L{prefix}/lib", f"-Wl,-rpath,{prefix}/lib", "-lwayfold"])
        return [program]


def run(command, variables=None, **options):
    """Runs a command, with more variables in its environment; its output is text."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, timeout=MAX_BUILD_S,
                          env={**os.environ, **(variables or {})}, **options)
    assert done.returncode == 0, f"{command[0]}: {done.stderr}"
    return done

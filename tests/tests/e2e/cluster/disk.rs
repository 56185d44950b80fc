//! Disks of their own for the servers: file systems in files. They lose their power, and they become full.
//!
//! The kernel's own ioctl shuts a file system down without writing what was not synced. Files that were synced are there
//! after the next mount, as after a loss of power. A real disk may lose more: this one keeps what the kernel has given to it
//! without a flush.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

/// The size of a disk. The file takes only the room of the written blocks.
const BYTES: u64 = 512 << 20;
/// `EXT4_IOC_SHUTDOWN` with `EXT4_GOING_FLAGS_NOLOGFLUSH`. Rust has no safe ioctl.
const SHUT_DOWN: &str = "import fcntl, os, struct, sys\n\
    fcntl.ioctl(os.open(sys.argv[1], os.O_RDONLY), 0x8004587D, struct.pack('I', 2))";

/// A mounted file system in a file.
pub(super) struct Disk {
    image: PathBuf,
    mount: PathBuf,
}

impl Disk {
    /// Makes a disk and mounts it at a directory.
    pub(super) fn new(image: PathBuf, mount: PathBuf) -> Self {
        let file = fs::File::create(&image).unwrap();
        file.set_len(BYTES).unwrap();
        // Without blocks that only root may use: the servers are root's.
        run(Command::new("mkfs.ext4")
            .args(["-q", "-m", "0"])
            .arg(&image));
        fs::create_dir(&mount).unwrap();
        let disk = Self { image, mount };
        disk.mount();
        disk
    }

    fn mount(&self) {
        let mut command = Command::new("mount");
        run(command
            .args(["-o", "loop"])
            .args([&self.image, &self.mount]));
    }

    fn unmount(&self) {
        run(Command::new("umount").arg(&self.mount));
    }

    /// Writes all that was not synced.
    pub(super) fn sync(&self) {
        run(Command::new("sync").arg("--file-system").arg(&self.mount));
    }

    /// From now on nothing is written. The processes with open files stand still.
    pub(super) fn lose_power(&self) {
        // This is the control: it is not synced, so it is lost.
        fs::write(self.control(), "lost").unwrap();
        run(Command::new("python3")
            .args(["-c", SHUT_DOWN])
            .arg(&self.mount));
    }

    /// Mounts it again once its processes have ended.
    pub(super) fn regain_power(&self) {
        self.unmount();
        self.mount();
        let control = fs::read(self.control()).unwrap_or_default();
        assert!(control.is_empty(), "the disk lost nothing");
        // The file system writes a file at once if it replaces another.
        let _ = fs::remove_file(self.control());
    }

    /// Takes all room.
    pub(super) fn fill(&self) {
        let space = Command::new("df")
            .args(["--output=avail", "-B1"])
            .arg(&self.mount)
            .output()
            .unwrap();
        let space = String::from_utf8(space.stdout).unwrap();
        let bytes = space.lines().nth(1).expect("a number").trim().to_owned();
        // The disk may take a block for the list of the blocks.
        let taken = Command::new("fallocate")
            .args(["-l", &bytes])
            .arg(self.ballast())
            .stderr(std::process::Stdio::null())
            .status();
        taken.unwrap();
        // The rest, to the last byte.
        let rest = fs::File::options()
            .create(true)
            .append(true)
            .open(self.ballast());
        let written = std::io::copy(&mut std::io::repeat(1), &mut rest.unwrap());
        let error = written.expect_err("a full disk");
        assert_eq!(error.kind(), std::io::ErrorKind::StorageFull);
    }

    /// Gives the room back.
    pub(super) fn free(&self) {
        fs::remove_file(self.ballast()).unwrap();
    }

    fn ballast(&self) -> PathBuf {
        self.mount.join("ballast")
    }

    fn control(&self) -> PathBuf {
        self.mount.join("control")
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        // A process of a failed test may still have it open; the mount namespace ends with the test.
        let _ = Command::new("umount")
            .arg("--lazy")
            .arg(&self.mount)
            .status();
    }
}

/// Runs a program that has to succeed.
pub(super) fn run(command: &mut Command) {
    let output = command.output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {error}");
}

/// The files below a directory.
pub(super) fn files(directory: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => found.extend(files(&path)),
            false => found.push(path),
        }
    }
    found.sort();
    found
}

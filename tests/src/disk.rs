//! A disk that is soon full, and one that cannot be written to.

use std::fs;
use std::path::Path;
use std::process::Command;

/// A file system of 256 kB, gone with it.
pub struct SmallDisk<'f>(&'f Path);

impl<'f> SmallDisk<'f> {
    /// Mounts one at `path`; `None` where that is not allowed, as it takes root.
    pub fn mount(path: &'f Path) -> Option<Self> {
        fs::create_dir_all(path).ok()?;
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", "size=256k", "none"]).arg(path);
        mount
            .output()
            .is_ok_and(|end| end.status.success())
            .then_some(Self(path))
    }
}

impl Drop for SmallDisk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

/// An empty file system that cannot be written to, gone with it.
pub struct ReadOnly<'f>(&'f Path);

impl<'f> ReadOnly<'f> {
    /// Mounts one at `path`; `None` where that is not allowed, as it takes root.
    pub fn mount(path: &'f Path) -> Option<Self> {
        fs::create_dir_all(path).ok()?;
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", "ro,size=64k", "none"]).arg(path);
        mount
            .output()
            .is_ok_and(|end| end.status.success())
            .then_some(Self(path))
    }
}

impl Drop for ReadOnly<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

//! The files of a run folder, or the recording, for download; `page/files.js` links them.
//!
//! A requested name is compared with the names of the listing and never joined to a path. The listing holds regular
//! files with results of the run, so that no request reaches another file.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use rustix::fs::OFlags;
use serde_json::{Value, json};

use super::api::ApiState;
use super::http::{ApiError, ApiResult, PathPart};
use crate::recording::RECORDING_EXTENSION;
use crate::run_folder::is_result_file;
use crate::scenario_files;

/// Bytes that are read at a time.
const CHUNK: usize = 256 * 1024;

/// A file that the page can download.
#[derive(Debug)]
struct ServedFile {
    /// Its path below the run folder, with `/`; the file name of a recording.
    name: String,
    path: PathBuf,
    bytes: u64,
}

/// Lists the files of a run at `path`: a run folder with its recordings, or a recording.
///
/// # Errors
/// If the folder or the recording cannot be read.
fn list(path: &Path) -> io::Result<Vec<ServedFile>> {
    let metadata = path.metadata()?;
    if metadata.is_dir() {
        let is_recording = |name: &str| {
            Path::new(name)
                .extension()
                .is_some_and(|end| end == RECORDING_EXTENSION)
        };
        let mut files = regular_files(path, "", |name| is_result_file(name) || is_recording(name))?;
        let copies = path.join(scenario_files::FOLDER);
        // A symbolic link has the metadata of a link.
        if copies.symlink_metadata().is_ok_and(|found| found.is_dir()) {
            files.extend(regular_files(&copies, &format!("{}/", scenario_files::FOLDER), |_| {
                true
            })?);
        }
        files.sort_unstable_by(|one, other| one.name.cmp(&other.name));
        return Ok(files);
    }
    Ok(vec![ServedFile {
        name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        // The user may name a link to the recording.
        path: path.canonicalize()?,
        bytes: metadata.len(),
    }])
}

/// Lists the regular files of a folder whose names pass `is_listed`.
fn regular_files(folder: &Path, prefix: &str, is_listed: impl Fn(&str) -> bool) -> io::Result<Vec<ServedFile>> {
    let mut files = Vec::new();
    for entry in folder.read_dir()? {
        let entry = entry?;
        // A file can disappear meanwhile. The metadata of an entry does not follow symbolic links.
        let (Ok(name), Ok(metadata)) = (entry.file_name().into_string(), entry.metadata()) else {
            continue;
        };
        if metadata.is_file() && is_listed(&name) {
            files.push(ServedFile {
                name: format!("{prefix}{name}"),
                path: entry.path(),
                bytes: metadata.len(),
            });
        }
    }
    Ok(files)
}

/// Opens the listed file with this name.
fn open(path: &Path, name: &str) -> io::Result<File> {
    let found = list(path)?.into_iter().find(|file| file.name == name);
    let unknown = || {
        io::Error::new(
            io::ErrorKind::NotFound,
            "not a file of the run; use a name of api/files",
        )
    };
    // Not followed, in case a link has replaced the file since.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    OpenOptions::new()
        .read(true)
        .custom_flags(flags.bits().cast_signed())
        .open(found.ok_or_else(unknown)?.path)
}

/// The path of the run's files.
fn path_of(served: &ApiState) -> Result<PathBuf, ApiError> {
    let why = "the run folder belongs to another process; start the run with --dashboard to download its files";
    let path = served.feed.path().map(Path::to_owned);
    path.ok_or_else(|| ApiError(StatusCode::NOT_FOUND, why.to_owned()))
}

/// The answer about a file or folder that cannot be read.
fn unreadable(what: &str, error: &io::Error) -> ApiError {
    ApiError(StatusCode::NOT_FOUND, format!("{what}: {error}"))
}

/// Serves the names and sizes of the files.
pub(super) async fn files(State(served): State<ApiState>) -> ApiResult {
    let path = path_of(&served)?;
    let folder = path.display().to_string();
    let listed = served.read_feed(move |_| list(&path)).await?;
    let listed = listed.map_err(|error| unreadable(&folder, &error))?;
    let entry = |file: ServedFile| json!({ "name": file.name, "bytes": file.bytes });
    Ok(Json(listed.into_iter().map(entry).collect::<Value>()))
}

/// Serves the content of a file.
pub(super) async fn file(
    State(served): State<ApiState>,
    PathPart(name): PathPart<String>,
) -> Result<impl IntoResponse, ApiError> {
    let path = path_of(&served)?;
    let what = format!("{name} in {}", path.display());
    let opened = served.read_feed(move |_| open(&path, &name)).await?;
    let file = opened.map_err(|error| unreadable(&what, &error))?;
    // A file can be larger than the memory, and blocks a thread only while a chunk is read.
    let content = futures::stream::try_unfold(file, |mut file| async move {
        let read = tokio::task::spawn_blocking(move || {
            let mut chunk = vec![0; CHUNK];
            let length = file.read(&mut chunk)?;
            chunk.truncate(length);
            Ok::<_, io::Error>((length > 0).then_some((chunk, file)))
        });
        read.await.map_err(io::Error::other)?
    });
    let headers = [
        // The browser saves the file and does not run it as a page of this server.
        (header::CONTENT_TYPE, "application/octet-stream"),
        (header::CONTENT_DISPOSITION, "attachment"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::CACHE_CONTROL, "no-store"),
    ];
    Ok((headers, Body::from_stream(content)))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use reveille_tests::process::TestFolder;

    use super::*;

    #[test]
    fn only_regular_files_of_the_run_are_listed_and_opened() {
        let test_folder = TestFolder::new();
        let place = test_folder.join("place");
        let folder = place.join("run");
        fs::create_dir_all(folder.join(scenario_files::FOLDER)).expect("a folder");
        let secret = place.join("secret.mcap");
        for file in [
            secret.clone(),
            folder.join("scenario.toml"),
            folder.join("notes.txt"),
            folder.join("run.mcap"),
            folder.join("scenario-files/trace.csv"),
        ] {
            fs::write(file, "content").expect("written");
        }
        symlink(&secret, folder.join("events.csv")).expect("a link");
        symlink(&secret, folder.join("scenario-files/layout.csv")).expect("a link");
        symlink(&place, folder.join("summary.json")).expect("a link");
        let names =
            |path: &Path| -> Vec<String> { list(path).expect("a list").into_iter().map(|file| file.name).collect() };
        let own_files = ["run.mcap", "scenario-files/trace.csv", "scenario.toml"];
        assert_eq!(names(&folder), own_files);
        for name in own_files {
            open(&folder, name).expect(name);
        }
        let absolute = secret.to_string_lossy();
        for name in [
            "../secret.mcap",
            "scenario-files/../../secret.mcap",
            "./scenario.toml",
            "..",
            "",
            "notes.txt",
            "events.csv",
            "scenario-files/layout.csv",
            "summary.json/secret.mcap",
            &absolute,
        ] {
            assert!(open(&folder, name).is_err(), "{name} is served");
        }
        // The folder of the scenario files is a link itself.
        fs::remove_dir_all(folder.join(scenario_files::FOLDER)).expect("removed");
        symlink(&place, folder.join(scenario_files::FOLDER)).expect("a link");
        assert_eq!(names(&folder), ["run.mcap", "scenario.toml"]);
        assert_eq!(names(&secret), ["secret.mcap"]);
    }
}

//! Writer of recordings, which [`Recorder`](super::Recorder) drives. The order and the contents of the records are a
//! file format: raise [`VERSION`] with a change that the `reader` of an older program would misread.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Seek, Write};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, McapResult, WriteOptions};
use reveille_common::codec::WIRE_VERSION;
use reveille_common::message::{Frame, MessageKind};
use reveille_common::score::DIGEST_VERSION;

use super::bundle::{SCENARIO_FILE, ScenarioBundle};
use super::{SUMMARY_FILE, VERSION, log_time, reader, topic};
use crate::frame_line::FrameLine;
use crate::schemas::MessageSchemas;

/// Approximate size of a chunk before compression, bytes: the most data that a crash can lose. docs/inspecting.md
/// repeats it.
const CHUNK_BYTES: u64 = 256 << 10;
/// Compression level: the fastest.
const COMPRESSION_LEVEL: u32 = 1;

/// Writer of one recording.
pub struct RecordingWriter<W: Write + Seek> {
    mcap: mcap::Writer<W>,
    channels: BTreeMap<MessageKind, u16>,
    /// Number of frames so far.
    frame_count: u64,
    /// Whether a frame was written since the last flush.
    has_pending_frames: bool,
}

impl<W: Write + Seek> RecordingWriter<W> {
    /// Writes the start of a recording of the run called `run`, with the files of `bundle`.
    ///
    /// # Errors
    /// If the recording cannot be written.
    pub fn begin(out: W, run: &str, bundle: &ScenarioBundle) -> McapResult<Self> {
        let options = WriteOptions::new()
            .library(concat!("reveille ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_level(COMPRESSION_LEVEL)
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES));
        let mut mcap = mcap::Writer::with_options(out, options)?;
        // `reader` looks up all keys but `digest`, which is for other programs.
        let metadata = [
            ("recording", VERSION.to_string()),
            ("wire", WIRE_VERSION.to_string()),
            ("digest", DIGEST_VERSION.to_string()),
            ("run", run.to_owned()),
        ];
        mcap.write_metadata(&Metadata {
            name: reader::METADATA_NAME.to_owned(),
            metadata: metadata.map(|(key, value)| (key.to_owned(), value)).into(),
        })?;
        attach(&mut mcap, SCENARIO_FILE, "application/toml", bundle.text.as_bytes())?;
        for (name, bytes) in &bundle.referenced_files {
            attach(&mut mcap, name, "application/octet-stream", bytes)?;
        }
        let (schemas, mut channels) = (MessageSchemas::trace_all(), BTreeMap::new());
        for kind in MessageKind::ALL {
            let name = format!("reveille.{}.{}", kind.plane().name(), kind.name());
            let schema = mcap.add_schema(&name, "jsonschema", schemas.json_schema(*kind).to_string().as_bytes())?;
            let channel_metadata = [("direction", kind.direction()), ("about", kind.about())];
            let channel_metadata = channel_metadata
                .map(|(key, value)| (key.to_owned(), value.to_owned()))
                .into();
            channels.insert(
                *kind,
                mcap.add_channel(schema, &topic(*kind), "json", &channel_metadata)?,
            );
        }
        // Flushed, so that the scenario is in the file even if the run is killed in its first TTI.
        mcap.flush()?;
        Ok(Self {
            mcap,
            channels,
            frame_count: 0,
            has_pending_frames: false,
        })
    }

    /// Writes a frame. Its TTI must not be before the TTI of the frame before it.
    ///
    /// # Errors
    /// If the recording cannot be written.
    pub fn write(&mut self, frame: &Frame) -> McapResult<()> {
        let time = log_time(frame.tti);
        let header = MessageHeader {
            channel_id: self.channels[&frame.kind],
            // Wraps after 2³² frames, as in the reader.
            sequence: self.frame_count as u32,
            log_time: time,
            publish_time: time,
        };
        self.frame_count += 1;
        self.has_pending_frames = true;
        self.mcap
            .write_to_known_channel(&header, FrameLine::new(frame).to_json().as_bytes())
    }

    /// Number of frames written.
    pub const fn frame_count(&self) -> u64 {
        self.frame_count
    }

    /// Writes all pending frames to the file, if any.
    ///
    /// # Errors
    /// If they cannot be written.
    pub fn flush(&mut self) -> McapResult<()> {
        if std::mem::take(&mut self.has_pending_frames) {
            self.mcap.flush()?;
        }
        Ok(())
    }

    /// Completes the recording, with the text of the summary if the run has one, and returns the output.
    ///
    /// # Errors
    /// If the recording cannot be written.
    pub fn finish(mut self, summary: Option<&str>) -> McapResult<W> {
        if let Some(summary) = summary {
            attach(&mut self.mcap, SUMMARY_FILE, "application/json", summary.as_bytes())?;
        }
        self.mcap.finish()?;
        Ok(self.mcap.into_inner())
    }
}

fn attach<W: Write + Seek>(mcap: &mut mcap::Writer<W>, name: &str, media_type: &str, data: &[u8]) -> McapResult<()> {
    mcap.attach(&Attachment {
        log_time: 0,
        create_time: 0,
        name: name.to_owned(),
        media_type: media_type.to_owned(),
        data: Cow::Borrowed(data),
    })
}

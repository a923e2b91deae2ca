//! `reveille inspect export --to devices`: a table of all devices over time, for statistics programs. The columns are a
//! file format, [`COLUMNS`] and [`DeviceRow::csv_fields`]; docs/inspecting.md describes them. Energies are in units,
//! and totals count from TTI 0, warm-up included.

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::DeviceTotals;

use crate::device_mirror::{DeviceMirror, Discrepancy};

/// The columns.
pub const COLUMNS: [&str; 10] = [
    "tti",
    "device",
    "state",
    "powered",
    "battery_units",
    "sensing_units",
    "sleep_units",
    "report_units",
    "harvested_units",
    "overflow_units",
];

/// A device at the end of a TTI.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceRow {
    /// The TTI.
    pub tti: Tti,
    device: DeviceId,
    view: DeviceView,
    /// Totals since TTI 0.
    totals: DeviceTotals,
}

impl DeviceRow {
    /// Formats the row as the fields of a CSV line.
    pub fn csv_fields(&self) -> [String; COLUMNS.len()] {
        let (state, is_powered) = match self.view.state {
            DeviceState::Idle => ("S1", true),
            DeviceState::Active => ("S2", true),
            DeviceState::Transmission => ("S3", true),
            DeviceState::Sleep { powered } => ("S4", powered),
            DeviceState::Failed => ("failed", false),
        };
        let spent = self.totals.spent;
        [
            self.tti.to_string(),
            self.device.to_string(),
            state.to_owned(),
            u8::from(is_powered).to_string(),
            self.view.battery.decimal_units(),
            spent.sensing.decimal_units(),
            spent.sleep.decimal_units(),
            spent.report.decimal_units(),
            self.totals.harvested.decimal_units(),
            self.totals.overflow.decimal_units(),
        ]
    }
}

/// Computes the rows of a run from its frames.
pub struct DeviceRows {
    mirror: DeviceMirror,
    /// TTIs between two rows of a device.
    interval: u64,
    /// The next TTI with rows.
    next_row: Tti,
    /// The last TTI with rows.
    last_row: Option<Tti>,
}

impl DeviceRows {
    /// Starts a table of a run of `scenario` with a row per device at the end of every `interval` TTIs, at least 1.
    pub fn new(scenario: &Scenario, interval: u64) -> Self {
        Self {
            mirror: DeviceMirror::new(scenario, &Deployment::new(scenario)),
            interval,
            next_row: Tti(interval - 1),
            last_row: None,
        }
    }

    /// Applies `frame`, unless it cannot be decoded, and passes the rows that it completes to `on_row`.
    ///
    /// # Errors
    /// If the frame contradicts the frames before it, or `on_row` returns an error. No frame may follow an error.
    pub fn apply<E: From<Discrepancy>>(
        &mut self,
        frame: &Frame,
        on_row: &mut impl FnMut(DeviceRow) -> Result<(), E>,
    ) -> Result<(), E> {
        let Ok(message) = frame.message() else {
            return Ok(());
        };
        // A plan or a grant closes the current TTI, so its states are final.
        if matches!(message, Message::Plan(_) | Message::World(_)) {
            self.pass_rows_before(self.mirror.next_tti(), on_row)?;
        }
        if let Message::World(world) = &message {
            let tti = frame.tti;
            let checked = self.mirror.check_grant(world);
            checked.map_err(|description| Discrepancy { tti, description })?;
            // Devices act only in the last TTI of a grant, so the states of the other TTIs are final too.
            self.pass_rows_before(world.last, on_row)?;
        }
        Ok(self.mirror.apply(frame, &message)?)
    }

    /// Passes the remaining rows to `on_row`, including the rows of the last TTI.
    ///
    /// # Errors
    /// If `on_row` returns an error.
    pub fn finish<E>(mut self, on_row: &mut impl FnMut(DeviceRow) -> Result<(), E>) -> Result<(), E> {
        self.pass_rows_before(self.mirror.next_tti(), on_row)?;
        match self.mirror.current_tti() {
            Some(last) if self.last_row < Some(last) => self.pass_rows(last, on_row),
            Some(_) | None => Ok(()),
        }
    }

    fn pass_rows_before<E>(&mut self, end: Tti, on_row: &mut impl FnMut(DeviceRow) -> Result<(), E>) -> Result<(), E> {
        while self.next_row < end {
            self.pass_rows(self.next_row, on_row)?;
            self.next_row = Tti(self.next_row.0.saturating_add(self.interval));
        }
        Ok(())
    }

    fn pass_rows<E>(&mut self, tti: Tti, on_row: &mut impl FnMut(DeviceRow) -> Result<(), E>) -> Result<(), E> {
        self.last_row = Some(tti);
        let devices = (0..).map(DeviceId).zip(self.mirror.views_and_totals_at(tti));
        for (device, (view, totals)) in devices {
            on_row(DeviceRow {
                tti,
                device,
                view,
                totals,
            })?;
        }
        Ok(())
    }
}

//! The order in which places should be covered, and the devices that can cover them.

use reveille_common::geometry::Point;

use crate::beliefs::grid::Raster;

/// Cells along the side of a block.
const BLOCK: usize = 4;

/// The places that devices can cover, in blocks of neighbours, the most confined blocks first. Few devices reach a
/// corner of the area, and their discs have little area elsewhere. So covering a corner first hardly affects the other
/// places. An order from the middle leaves slivers along the borders, which need more devices in the end.
#[derive(Clone, Debug)]
pub(super) struct CellBlocks {
    pub(super) blocks: Vec<Block>,
    /// Cells of all blocks, grouped by block.
    pub(super) spots: Vec<CellPosition>,
    /// Devices that cover some cell of a block, in ascending order, grouped by block.
    pub(super) devices: Vec<u32>,
}

/// A block of cells: its corner, and the ranges of its places and devices.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    pub(super) row: u32,
    pub(super) column: u32,
    /// Number of its rows, and of its columns, in the area.
    pub(super) rows: u32,
    pub(super) columns: u32,
    pub(super) spots: (u32, u32),
    pub(super) devices: (u32, u32),
}

/// A place: a cell that some device can cover.
#[derive(Clone, Copy, Debug)]
pub struct CellPosition {
    pub(super) row: u32,
    pub(super) column: u32,
}

impl CellBlocks {
    /// Creates the blocks of the places of `raster` that devices at `positions` can cover. `reaches` decides this for a
    /// device, row and column, and is false beyond `d_max`.
    pub(super) fn new(
        raster: &Raster,
        positions: &[Point],
        d_max: f64,
        reaches: impl Fn(usize, u32, u32) -> bool,
    ) -> Self {
        let (rows, columns) = (raster.rows as u32, raster.columns as u32);
        let in_block = |corner: (u32, u32)| {
            let own = |at: u32, count: u32| at..(at + BLOCK as u32).min(count);
            own(corner.0, rows).flat_map(move |row| own(corner.1, columns).map(move |column| (row, column)))
        };
        let across = raster.columns.div_ceil(BLOCK);
        let mut near: Vec<Vec<u32>> = vec![Vec::new(); raster.rows.div_ceil(BLOCK) * across];
        for (j, &p) in positions.iter().enumerate() {
            let [rows, columns] = raster
                .around(p, d_max)
                .map(|cells| cells.start / BLOCK..cells.end.div_ceil(BLOCK));
            for block in rows.flat_map(|row| columns.clone().map(move |column| (row, column))) {
                let corner = ((block.0 * BLOCK) as u32, (block.1 * BLOCK) as u32);
                if in_block(corner).any(|(row, column)| reaches(j, row, column)) {
                    near[block.0 * across + block.1].push(j as u32);
                }
            }
        }
        // Area, in cells, of the square of side 2·d_max around a cell, as far as it lies in the area.
        let range = (d_max / raster.width.max(raster.height)) as u32;
        let room = |row: u32, column: u32| {
            let side = |at: u32, count: u32| at.min(count - 1 - at).min(range) + range;
            u64::from(side(row, rows)) * u64::from(side(column, columns))
        };
        let middle = |at: usize, count: u32| (at as u32 * BLOCK as u32 + BLOCK as u32 / 2).min(count - 1);
        let of_block = |i: usize| (room(middle(i / across, rows), middle(i % across, columns)), i);
        let mut order: Vec<(u64, usize)> = (0..near.len()).map(of_block).collect();
        order.sort_unstable();
        let (mut blocks, mut spots, mut devices) = (Vec::new(), Vec::new(), Vec::new());
        for (_, i) in order {
            let corner = ((i / across * BLOCK) as u32, (i % across * BLOCK) as u32);
            let is_seen = |&(row, column): &(u32, u32)| near[i].iter().any(|&j| reaches(j as usize, row, column));
            let mut seen: Vec<(u32, u32)> = in_block(corner).filter(is_seen).collect();
            seen.sort_by_key(|&(row, column)| room(row, column));
            let (first_spot, first_device) = (spots.len() as u32, devices.len() as u32);
            spots.extend(seen.into_iter().map(|(row, column)| CellPosition { row, column }));
            devices.append(&mut near[i]);
            blocks.push(Block {
                row: corner.0,
                column: corner.1,
                rows: (rows - corner.0).min(BLOCK as u32),
                columns: (columns - corner.1).min(BLOCK as u32),
                spots: (first_spot, spots.len() as u32),
                devices: (first_device, devices.len() as u32),
            });
        }
        Self { blocks, spots, devices }
    }

    /// Creates a single place, which each of `count` devices can cover in part and none fully.
    pub(super) fn one(count: usize) -> Self {
        Self {
            blocks: vec![Block {
                row: 0,
                column: 0,
                rows: 1,
                columns: 1,
                spots: (0, 1),
                devices: (0, count as u32),
            }],
            spots: vec![CellPosition { row: 0, column: 0 }],
            devices: (0..count as u32).collect(),
        }
    }
}

//! The order in which cells should be covered, and the devices that can cover them. The greedy choice of `q-learning`
//! (`policy/q_learning/area_state/selector.rs`) walks through blocks, cells and devices in this order, so
//! digests depend on it.

use reveille_common::geometry::Point;

use crate::beliefs::grid::Raster;

/// Rows, and columns, of a block. The order of cells, and so digests, depend on it. A block has as many cells as a
/// `u16` has bits: [`Block::cell_bits`].
pub(super) const BLOCK_SIDE: usize = 4;

/// The cells that devices can cover, in blocks of neighbours, the most confined blocks first. Few devices reach a
/// corner of the area, and their discs have little area elsewhere. So covering a corner first hardly affects the other
/// cells. An order from the middle leaves slivers along the borders, which need more devices in the end.
#[derive(Clone, Debug)]
pub(super) struct CellBlocks {
    pub(super) blocks: Vec<Block>,
    /// Cells of all blocks, grouped by block.
    pub(super) cells: Vec<CellPosition>,
    /// Devices that cover some cell of a block, in ascending order, grouped by block.
    pub(super) devices: Vec<u32>,
}

/// A block of cells: the place of its south-west corner (`CoverageBits::place`), and the ranges (start, end) of its
/// cells and devices in [`CellBlocks`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    pub(super) word: u32,
    pub(super) shift: u8,
    /// Its cells, see [`CellPosition::block_bit`].
    pub(super) cell_bits: u16,
    pub(super) cells: (u32, u32),
    pub(super) devices: (u32, u32),
}

/// A cell that some device can cover.
#[derive(Clone, Copy, Debug)]
pub struct CellPosition {
    pub(super) row: u32,
    pub(super) column: u32,
    block_bit: u16,
}

impl CellPosition {
    /// Bit of the cell in its block, row by row from the south-west corner.
    #[inline(always)]
    pub(crate) const fn block_bit(self) -> u16 {
        self.block_bit
    }
}

impl CellBlocks {
    /// Creates the blocks of the cells of `raster` that devices at `positions` can cover. `reaches` decides this for a
    /// device, row and column, and is false beyond `d_max`. `place` is `CoverageBits::place` of a row and column.
    pub(super) fn new(
        raster: &Raster,
        positions: &[Point],
        d_max: f64,
        reaches: impl Fn(usize, u32, u32) -> bool,
        place: impl Fn(u32, u32) -> (u32, u8),
    ) -> Self {
        let (rows, columns) = (raster.rows as u32, raster.columns as u32);
        let cells_at = |corner: (u32, u32)| {
            let side_range = |index: u32, count: u32| index..(index + BLOCK_SIDE as u32).min(count);
            side_range(corner.0, rows)
                .flat_map(move |row| side_range(corner.1, columns).map(move |column| (row, column)))
        };
        let blocks_per_row = raster.columns.div_ceil(BLOCK_SIDE);
        let mut devices_by_block: Vec<Vec<u32>> = vec![Vec::new(); raster.rows.div_ceil(BLOCK_SIDE) * blocks_per_row];
        for (j, &position) in positions.iter().enumerate() {
            let [block_rows, block_columns] = raster
                .disc_bounds(position, d_max)
                .map(|cells| cells.start / BLOCK_SIDE..cells.end.div_ceil(BLOCK_SIDE));
            let blocks = block_rows.flat_map(|row| block_columns.clone().map(move |column| (row, column)));
            for (block_row, block_column) in blocks {
                let corner = ((block_row * BLOCK_SIDE) as u32, (block_column * BLOCK_SIDE) as u32);
                if cells_at(corner).any(|(row, column)| reaches(j, row, column)) {
                    devices_by_block[block_row * blocks_per_row + block_column].push(j as u32);
                }
            }
        }
        // Area, in cells, of the square of side 2·d_max around a cell, as far as it lies in the area.
        let range_in_cells = (d_max / raster.cell_width.max(raster.cell_height)) as u32;
        let area_in_reach = |row: u32, column: u32| {
            let side = |index: u32, count: u32| index.min(count - 1 - index).min(range_in_cells) + range_in_cells;
            u64::from(side(row, rows)) * u64::from(side(column, columns))
        };
        let middle =
            |index: usize, count: u32| (index as u32 * BLOCK_SIDE as u32 + BLOCK_SIDE as u32 / 2).min(count - 1);
        let area_and_block = |i: usize| {
            (
                area_in_reach(middle(i / blocks_per_row, rows), middle(i % blocks_per_row, columns)),
                i,
            )
        };
        let mut order: Vec<(u64, usize)> = (0..devices_by_block.len()).map(area_and_block).collect();
        order.sort_unstable();
        let (mut blocks, mut cells, mut devices) = (Vec::new(), Vec::new(), Vec::new());
        for (_, i) in order {
            // Blocks that no device covers are left out.
            if devices_by_block[i].is_empty() {
                continue;
            }
            let corner = (
                (i / blocks_per_row * BLOCK_SIDE) as u32,
                (i % blocks_per_row * BLOCK_SIDE) as u32,
            );
            let is_reachable =
                |&(row, column): &(u32, u32)| devices_by_block[i].iter().any(|&j| reaches(j as usize, row, column));
            let mut reachable: Vec<(u32, u32)> = cells_at(corner).filter(is_reachable).collect();
            reachable.sort_by_key(|&(row, column)| area_in_reach(row, column));
            let (first_cell, first_device) = (cells.len() as u32, devices.len() as u32);
            cells.extend(reachable.into_iter().map(|(row, column)| CellPosition {
                row,
                column,
                block_bit: 1 << ((row - corner.0) * BLOCK_SIDE as u32 + column - corner.1),
            }));
            devices.append(&mut devices_by_block[i]);
            let (word, shift) = place(corner.0, corner.1);
            blocks.push(Block {
                word,
                shift,
                cell_bits: cells[first_cell as usize..]
                    .iter()
                    .fold(0, |bits, cell: &CellPosition| bits | cell.block_bit),
                cells: (first_cell, cells.len() as u32),
                devices: (first_device, devices.len() as u32),
            });
        }
        Self { blocks, cells, devices }
    }

    /// Creates a single cell, which each of `count` devices can cover in part and none fully.
    pub(super) fn single(count: usize) -> Self {
        Self {
            blocks: vec![Block {
                word: 0,
                shift: 0,
                cell_bits: 1,
                cells: (0, 1),
                devices: (0, count as u32),
            }],
            cells: vec![CellPosition {
                row: 0,
                column: 0,
                block_bit: 1,
            }],
            devices: (0..count as u32).collect(),
        }
    }
}

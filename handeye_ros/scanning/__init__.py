"""Points in the base from a calibration: scans, and seams in them."""

OFFERED = (
    'cloud_files.FORMATS', 'cloud_files.cloud_writer', 'cloud_files.header_of',
    'cloud_files.read_cloud', 'errors.NeedsCalibrationError', 'scan.ScanCount',
    'scan.ScanOptions', 'scan.Scanner', 'seam.Seam', 'seam.ToolFrames', 'seam.draw_seam',
    'seam.find_seam', 'seam.tool_frames', 'seam_files',
)

"""Points in the base with a calibration: clouds of scans, seams in them."""

OFFERED = (
    'cloud_files.FORMATS', 'cloud_files.cloud_writer', 'cloud_files.header_of',
    'cloud_files.read_cloud', 'errors.NeedsCalibrationError', 'pictures.draw_seam',
    'scan.ScanCount', 'scan.ScanOptions', 'scan.Scanner', 'seam.Seam', 'seam.ToolFrames',
    'seam.find_seam', 'seam.tool_frames', 'seam_files',
)

"""Export XFeat to ONNX: python models/export.py [--out DIR]. Prints what was written, its parity and checksums."""

import argparse
import sys
from pathlib import Path

from physpose_torch.errors import PhysPoseError
from physpose_torch.table.manifest import read_manifest
from physpose_torch.table.xfeat_export import cached_export, check_parity, export


def main() -> None:
    """Export, and say what came of it."""
    parser = argparse.ArgumentParser(description="Export XFeat to ONNX and compare it with the original.")
    parser.add_argument("--out", type=Path, help="folder; if not given, the cache (PHYSPOSE_CACHE)")
    out = parser.parse_args().out
    try:
        records = read_manifest(export(out)) if out else cached_export()
        print(f"largest difference from the original: {check_parity(*(r.file for r in records)):.2g}")
    except (PhysPoseError, OSError) as error:
        sys.exit(f"error: {error}")
    for record in records:
        print(f"{record.sha256}  {record.file}")


if __name__ == "__main__":
    main()

"""Fills column E of the first sheet of a workbook in a running LibreOffice; run by a Python that has its ``uno``.

Arguments: the pipe of the office, the file to open, the file to save, the first row (from 0). Each cell gets the last
choice of its list. Prints how the formula of cell B2 then reads, and the columns whose cells are locked.
"""

import contextlib
import importlib
import sys
import time
from typing import Any

uno: Any = importlib.import_module("uno")
DisconnectedError = uno.getClass("com.sun.star.lang.DisposedException")
NotYetError = uno.getClass("com.sun.star.connection.NoConnectException")


def connected(pipe: str) -> Any:
    """The desktop of the office, which may still be starting."""
    context = uno.getComponentContext()
    resolver = context.ServiceManager.createInstanceWithContext("com.sun.star.bridge.UnoUrlResolver", context)
    end = time.monotonic() + 200
    while True:
        try:
            office = resolver.resolve(f"uno:pipe,name={pipe};urp;StarOffice.ComponentContext")
            return office.ServiceManager.createInstanceWithContext("com.sun.star.frame.Desktop", office)
        except NotYetError:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def option(name: str, value: Any) -> Any:
    return uno.createUnoStruct("com.sun.star.beans.PropertyValue", name, 0, value, 0)


def fill(desktop: Any, source: str, target: str, first: int) -> None:
    book = desktop.loadComponentFromURL(source, "_blank", 0, (option("Hidden", True),))
    page = book.Sheets.getByIndex(0)
    row = first
    while page.getCellByPosition(0, row).String:
        cell = page.getCellByPosition(4, row)
        cell.String = cell.Validation.getFormula1().split(",")[-1].split(";")[-1].strip('"')
        row += 1
    print(page.getCellByPosition(1, 1).String)
    locked = [name for k, name in enumerate("ABCDE") if page.getCellByPosition(k, first).CellProtection.IsLocked]
    print("".join(locked) if page.isProtected() else "nothing is protected")
    book.storeToURL(target, (option("FilterName", "Calc MS Excel 2007 XML"),))
    book.close(True)
    with contextlib.suppress(DisconnectedError):  # the office may be gone before it answers
        desktop.terminate()


fill(connected(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]))

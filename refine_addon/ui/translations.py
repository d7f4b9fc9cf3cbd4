"""The interface in German: names and tooltips. Sentences with numbers stay English.

A new label needs a line here; `tests/addon/test_translations.py` names those that lack one.
"""

from __future__ import annotations

import bpy

GERMAN = {
    "1 Splats": "1 Splats",
    "2 Cameras": "2 Kameras",
    "3 Score": "3 Bewerten",
    "4 Preview": "4 Vorschau",
    "5 Apply": "5 Anwenden",
    "6 Export": "6 Exportieren",
    "A closed mesh, or an empty that is shown as a cube or a sphere": (
        "Ein geschlossenes Mesh oder ein Leerobjekt, das als Würfel oder Kugel gezeigt wird"
    ),
    "A new box around the middle of the splats": "Ein neuer Quader um die Mitte der Splats",
    "A new sphere around the middle of the splats": "Eine neue Kugel um die Mitte der Splats",
    "A sphere, for the viewport": "Eine Kugel, für die 3D-Ansicht",
    "About the world's X axis": "Um die X-Achse der Welt",
    "Absorb": "Aufnehmen",
    "Active": "Aktive",
    "Add Volume": "Volumen hinzufügen",
    "Add a Ring of Cameras": "Einen Ring von Kameras hinzufügen",
    "Add a volume to the list": "Der Liste ein Volumen hinzufügen",
    "Add cameras around the splats that see all of them; they decide with those there are": (
        "Kameras um die Splats hinzufügen, die alle sehen; sie entscheiden mit den vorhandenen"
    ),
    "Advanced": "Erweitert",
    "All cameras that are visible in the scene": "Alle Kameras, die in der Szene sichtbar sind",
    "All splats go that are in no volume of this kind": (
        "Alle Splats gehen, die in keinem solchen Volumen liegen"
    ),
    "Along Axis": "Entlang der Achse",
    "Applied: score again for more": "Angewendet: für mehr erneut bewerten",
    "Apply": "Anwenden",
    "Apply Transform": "Transformation anwenden",
    "As Upright": "Wie Aufrecht",
    "Auto": "Automatisch",
    "Back": "Zurück",
    "Box": "Quader",
    "Budget": "Budget",
    "By how much the PSNR of the pictures may be lower than by Occlusion, in dB": (
        "Um wie viel der PSNR der Bilder niedriger sein darf als mit Verdeckung, in dB"
    ),
    "By the closed form, not yet refined": "Nach der geschlossenen Form, noch nicht verfeinert",
    "Cameras": "Kameras",
    "Change which splats are marked to stay": "Ändern, welche Splats als bleibend markiert sind",
    "Clear": "Leeren",
    "Closed Form": "Geschlossene Form",
    "Closed meshes, and empties shown as cubes or spheres, that are selected too": (
        "Geschlossene Meshes und als Würfel oder Kugel gezeigte Leerobjekte, die auch "
        "ausgewählt sind"
    ),
    "Collection": "Sammlung",
    "Colour": "Farbe",
    "Colour each splat by its rank: dark goes first, yellow goes last": (
        "Jeden Splat nach seinem Rang färben: Dunkles geht zuerst, Gelbes zuletzt"
    ),
    "Compare": "Vergleichen",
    "Convert Splats": "Splats umwandeln",
    "Count": "Anzahl",
    "Count a view only for the splats that lie in its frame or reach into it": (
        "Eine Ansicht nur für Splats zählen, die in ihrem Bild liegen oder hineinreichen"
    ),
    "Defaults for scenes into which splats are imported": (
        "Vorgaben für Szenen, in die Splats importiert werden"
    ),
    "Delete Floaters": "Schwebende löschen",
    "Delete Now": "Jetzt löschen",
    "Delete now what the volumes say must go, without scores; nothing else is deleted": (
        "Jetzt löschen, was nach den Volumen gehen muss, ohne Bewertung; nichts anderes wird "
        "gelöscht"
    ),
    "Delete the floaters that were found, for the reasons that are switched on": (
        "Die gefundenen schwebenden Splats löschen, aus den eingeschalteten Gründen"
    ),
    ("Delete the splats that the budget does not keep; with Absorb, survivors take them over"): (
        "Die Splats löschen, die das Budget nicht behält; mit Aufnehmen übernehmen sie die "
        "bleibenden"
    ),
    "Depth": "Tiefe",
    "Depth along the camera's axis, as in the paper": (
        "Tiefe entlang der Kameraachse, wie in der Veröffentlichung"
    ),
    "Distance": "Abstand",
    "Distance to the camera, as in the authors' code": (
        "Abstand zur Kamera, wie im Programm der Autoren"
    ),
    ("Draw what the active camera sees before and after Apply, and say how close both are in dB"): (
        "Zeichnen, was die aktive Kamera vor und nach Anwenden sieht, und sagen, wie nah sich "
        "beide sind, in dB"
    ),
    "End": "Ende",
    "Every how many frames": "Jeder wievielte Frame",
    "Export Splats": "Splats exportieren",
    "Far Away": "Weit weg",
    "File Size": "Dateigröße",
    "Find Floaters": "Schwebende finden",
    (
        "Find splats that stand where the cameras see that nothing is; nothing is deleted "
        "(Esc cancels)"
    ): (
        "Splats finden, die stehen, wo die Kameras nichts sehen; nichts wird gelöscht (Esc "
        "bricht ab)"
    ),
    "First frame": "Erster Frame",
    "Floaters": "Schwebende",
    "Floats, but changes no picture that anyone would see": (
        "Schwebt, ändert aber kein Bild sichtbar"
    ),
    "For Renders": "Für Renderbilder",
    "Format": "Format",
    "Frames": "Frames",
    "From y down to z up, as Upright turns what is imported": (
        "Von y unten nach z oben, wie Aufrecht Importiertes dreht"
    ),
    "From z up to y down": "Von z oben nach y unten",
    "Giant": "Riesig",
    ("Give cameras that see nothing, or all from far away, the weight 0: they no longer decide"): (
        "Kameras, die nichts oder alles von weit weg sehen, das Gewicht 0 geben: sie "
        "entscheiden nicht mehr"
    ),
    (
        "Give the scene the image size of the first camera, so that renders show what the "
        "cameras saw"
    ): (
        "Der Szene die Bildgröße der ersten Kamera geben, damit Renderbilder zeigen, was die "
        "Kameras sahen"
    ),
    "Heat": "Wärme",
    "Heat Map": "Wärmebild",
    "Hide What Goes": "Verbergen, was geht",
    "Hide the splats that the budget removes": "Die Splats verbergen, die das Budget entfernt",
    "How close its picture is estimated to stay; negative where nothing tells": (
        "Wie nah ihr Bild nach der Schätzung bleibt; negativ, wo nichts es sagt"
    ),
    (
        "How close the pictures of the cameras stay to those of all splats, in dB: 40 is hard "
        "to tell apart, 30 is seen"
    ): (
        "Wie nah die Bilder der Kameras denen aller Splats bleiben, in dB: 40 ist kaum zu "
        "unterscheiden, 30 sieht man"
    ),
    "How many splats lie in its view": "Wie viele Splats in ihrer Ansicht liegen",
    "How many splats stay": "Wie viele Splats bleiben",
    "How splats are scored": "Wie Splats bewertet werden",
    "Import Cameras": "Kameras importieren",
    "Import Splats": "Splats importieren",
    "Import cameras as objects: Inria cameras.json, nerfstudio transforms.json or COLMAP": (
        "Kameras als Objekte importieren: cameras.json von Inria, transforms.json von "
        "nerfstudio oder COLMAP"
    ),
    "Import files of splats, of any format: a vertex a splat, a point attribute a property": (
        "Dateien mit Splats importieren, in jedem Format: ein Vertex je Splat, ein "
        "Punktattribut je Eigenschaft"
    ),
    "In Front": "Davor",
    "In the layout that was imported": "In der Anordnung, die importiert wurde",
    "Index": "Index",
    "Is a huge veil across the pictures": "Ist ein riesiger Schleier vor den Bildern",
    "Is in a small cluster that touches nothing else": (
        "Gehört zu einem kleinen Haufen, der nichts anderes berührt"
    ),
    "Is long and thin, and crosses the pictures": (
        "Ist lang und dünn und zieht sich durch die Bilder"
    ),
    "Isolated": "Vereinzelt",
    "It holds activated values in single precision, with y up": (
        "Es enthält aktivierte Werte in einfacher Genauigkeit, mit y nach oben"
    ),
    "It holds colour, opacity and rotation in 8 bits each": (
        "Es enthält Farbe, Deckkraft und Drehung in je 8 Bit"
    ),
    "It holds every value in 8 to 11 bits, and sorts the splats": (
        "Es enthält jeden Wert in 8 bis 11 Bit und sortiert die Splats"
    ),
    ("It holds positions in 16 bits, all else in 8, takes harmonics from a palette, and sorts"): (
        "Es enthält Orte in 16 Bit, alles andere in 8, nimmt Harmonische aus einer Palette und "
        "sortiert"
    ),
    "It holds positions in 24 bits, all else in 8 to 10, and harmonics in 4 to 5": (
        "Es enthält Orte in 24 Bit, alles andere in 8 bis 10 und Harmonische in 4 bis 5"
    ),
    "It sees the splats from far away": "Sie sieht die Splats von weit weg",
    "Keep": "Behalten",
    "Keep Inside": "Inneres behalten",
    "Keep What Is Unseen": "Ungesehenes behalten",
    "Keep as many splats as fit in a file of this size": (
        "So viele Splats behalten, wie in eine Datei dieser Größe passen"
    ),
    "Keep this many splats": "So viele Splats behalten",
    "Knows what hides what; uses all views": "Weiß, was was verdeckt; nutzt alle Ansichten",
    "Last frame": "Letzter Frame",
    "Leave Them Out": "Auslassen",
    "Levels": "Stufen",
    "MB": "MB",
    "Make Levels": "Stufen anlegen",
    ("Make objects with ever fewer of the splats, by the cameras, in a collection of their own"): (
        "Objekte mit immer weniger Splats anlegen, nach den Kameras, in einer eigenen Sammlung"
    ),
    "Mark the selected splats to stay": "Die ausgewählten Splats als bleibend markieren",
    "Method": "Verfahren",
    "Mode": "Modus",
    "Needle": "Nadel",
    "Nested": "Verschachtelt",
    "Objects that say what must stay and go": "Objekte, die sagen, was bleiben und was gehen muss",
    "Occlusion": "Verdeckung",
    "Occlusion with no more views than the pictures need": (
        "Verdeckung mit nicht mehr Ansichten, als die Bilder brauchen"
    ),
    "Of the file that is picked here; a suffix that is typed chooses it": (
        "Der Datei, die hier gewählt wird; eine getippte Endung wählt es"
    ),
    "Off": "Aus",
    (
        "Only delete: each level is some of the splats of the one before, unchanged. Else "
        "survivors absorb what goes, which is far better"
    ): (
        "Nur löschen: jede Stufe ist ein Teil der Splats der vorigen, unverändert. Sonst nehmen "
        "bleibende Splats auf, was geht, was weit besser ist"
    ),
    "Only in Frame": "Nur im Bild",
    "Overwrite": "Überschreiben",
    "PSNR": "PSNR",
    "Place in the list": "Platz in der Liste",
    "Points": "Punkte",
    "Preview": "Vorschau",
    "Mark the splats that lie in no view to stay, with those that are marked": (
        "Die Splats, die in keiner Ansicht liegen, zu den bleibenden nehmen"
    ),
    "Price": "Preis",
    "Protect": "Schützen",
    "Protect Inside": "Inneres schützen",
    "Protect Selected": "Auswahl schützen",
    "Protect Splats": "Splats schützen",
    "Protect and Crop": "Schützen und beschneiden",
    "Published Constants": "Veröffentlichte Konstanten",
    "Quality": "Qualität",
    "Rank of each splat: dark goes first, yellow last": (
        "Rang jedes Splats: Dunkles geht zuerst, Gelbes zuletzt"
    ),
    "Release Selected": "Auswahl freigeben",
    "Remove": "Entfernen",
    "Remove Inside": "Inneres entfernen",
    "Remove as many splats as leave the pictures this close to the unpruned": (
        "So viele Splats entfernen, dass die Bilder den ursprünglichen so nah bleiben"
    ),
    "Remove from List": "Aus der Liste nehmen",
    "Remove splats that lie in fewer than this share of the views": (
        "Splats entfernen, die in weniger als diesem Anteil der Ansichten liegen"
    ),
    "Remove splats that score below this": "Splats entfernen, deren Wert darunter liegt",
    "Remove this share of the splats": "Diesen Anteil der Splats entfernen",
    "Replace the file if it exists": "Die Datei ersetzen, falls es sie gibt",
    "Role": "Aufgabe",
    "Scene": "Szene",
    "Scene Range": "Bereich der Szene",
    "Score": "Bewerten",
    "Score each splat by how much the cameras would miss it (Esc cancels)": (
        "Jeden Splat danach bewerten, wie sehr er den Kameras fehlen würde (Esc bricht ab)"
    ),
    "Scored and pruned as one scene": "Als eine Szene bewertet und ausgedünnt",
    "Seen by": "Gesehen von",
    "Selected": "Ausgewählte",
    "Selected Objects": "Ausgewählte Objekte",
    "Set Render Size": "Rendergröße setzen",
    "Shape": "Form",
    "Share": "Anteil",
    "Share of the splats to remove": "Anteil der Splats, der entfernt wird",
    "Share of the splats to remove, in per cent": (
        "Anteil der Splats, der entfernt wird, in Prozent"
    ),
    "Shares of the splats that stay in the levels of detail, the finest first": (
        "Anteile der Splats, die in den Detailstufen bleiben, die feinste zuerst"
    ),
    "Show": "Zeigen",
    "Show Splats": "Splats zeigen",
    "Show in Renders": "In Renderbildern zeigen",
    "Show the plain mesh again": "Wieder das bloße Mesh zeigen",
    "Show the plain points of the mesh again": "Wieder die bloßen Punkte des Meshs zeigen",
    "Show the splats as points, or in renders as they are, without changing them": (
        "Die Splats als Punkte zeigen, oder in Renderbildern wie sie sind, ohne sie zu ändern"
    ),
    "Show the splats as they are": "Die Splats zeigen, wie sie sind",
    "Show what Apply would leave": "Zeigen, was Anwenden übrig ließe",
    "Show what Apply would remove, in orange": "Zeigen, was Anwenden entfernen würde, in Orange",
    "Size of the exported file, in megabytes of a million bytes": (
        "Größe der exportierten Datei, in Megabyte zu einer Million Byte"
    ),
    "Sphere": "Kugel",
    "Splats": "Splats",
    "Splats in it go before all others": "Splats darin gehen vor allen anderen",
    "Splats in it stay, whatever else is said": "Splats darin bleiben, was auch sonst gesagt ist",
    "Splats that lie in fewer than this share of the views are removed": (
        "Splats, die in weniger als diesem Anteil der Ansichten liegen, werden entfernt"
    ),
    "Splats that score below this are removed": (
        "Splats, deren Wert darunter liegt, werden entfernt"
    ),
    "Stands in front of surfaces, seen by itself": "Steht vor Oberflächen, für sich gesehen",
    "Start": "Anfang",
    "Step": "Schritt",
    "Style": "Darstellung",
    (
        "Survivors take over what is removed, by what the cameras see of it: far better when "
        "much is removed, and slower; the survivors change"
    ): (
        "Bleibende Splats übernehmen, was entfernt wird, nach dem, was die Kameras davon sehen: "
        "weit besser, wenn viel entfernt wird, und langsamer; die bleibenden ändern sich"
    ),
    "Take the marks off all splats": "Die Markierung aller Splats aufheben",
    "Take the marks off the selected splats": "Die Markierung der ausgewählten Splats aufheben",
    "Take the volume off the list; the object stays": (
        "Das Volumen aus der Liste nehmen; das Objekt bleibt"
    ),
    "Takes nothing as hidden: far faster, and worse": (
        "Nimmt nichts als verdeckt an: weit schneller und schlechter"
    ),
    "The Gaussian itself, for pictures that Cycles renders": (
        "Die Gauß-Funktion selbst, für Bilder, die Cycles rendert"
    ),
    "The active camera at each frame of a range: an animated shot": (
        "Die aktive Kamera in jedem Frame eines Bereichs: eine animierte Einstellung"
    ),
    "The cameras of a collection, hidden ones too": "Die Kameras einer Sammlung, auch verborgene",
    "The cameras that are selected": "Die Kameras, die ausgewählt sind",
    "The collection of the cameras": "Die Sammlung der Kameras",
    "The scene's active camera, at the current frame": (
        "Die aktive Kamera der Szene, im aktuellen Frame"
    ),
    "The splat's own colour": "Die eigene Farbe des Splats",
    "Tolerance": "Toleranz",
    "Transparent": "Durchsichtig",
    "Turn": "Drehung",
    ("Turn a splat mesh into a point cloud of Blender's own splats, or such a point cloud back"): (
        "Ein Splat-Mesh in eine Punktwolke mit Blenders eigenen Splats verwandeln, oder eine "
        "solche zurück"
    ),
    "Turn the Cameras": "Die Kameras drehen",
    "Turn the cameras that decide a quarter about the world's X axis": (
        "Die entscheidenden Kameras um eine Vierteldrehung um die X-Achse der Welt drehen"
    ),
    (
        "Turn the object, not the data, a quarter about X: from the y-down world of COLMAP to "
        "the z-up world of Blender"
    ): (
        "Das Objekt, nicht die Daten, um eine Vierteldrehung um X drehen: aus der Welt von "
        "COLMAP mit y nach unten in die von Blender mit z nach oben"
    ),
    (
        "Turn the object, not the data, a quarter about X: from the y-down world of COLMAP to "
        "the z-up world of Blender. Choose what you chose for the splats"
    ): (
        "Das Objekt, nicht die Daten, um eine Vierteldrehung um X drehen: aus der Welt von "
        "COLMAP mit y nach unten in die von Blender mit z nach oben. Wählen, was für die Splats "
        "gewählt wurde"
    ),
    "Update": "Aktualisieren",
    "Upright": "Aufrecht",
    "Use at most this many views, spread out evenly; 0 uses all": (
        "Höchstens so viele Ansichten nutzen, gleichmäßig verteilt; 0 nutzt alle"
    ),
    (
        "Use the constants of the paper or its code as they are; they assume a scene in "
        "metres and count splats that lie outside the frame"
    ): (
        "Die Konstanten der Veröffentlichung oder ihres Programms nutzen, wie sie sind; sie "
        "setzen eine Szene in Metern voraus und zählen Splats außerhalb des Bildes mit"
    ),
    "Use the frame range of the scene": "Den Framebereich der Szene nutzen",
    "Vertex group, or boolean or float point attribute: the splats in it stay": (
        "Vertexgruppe, oder boolesches oder Gleitkomma-Punktattribut: die Splats darin bleiben"
    ),
    "Views": "Ansichten",
    "Visible": "Sichtbare",
    "Volume": "Volumen",
    "Volumes": "Volumen",
    "What Each Sees": "Was jede sieht",
    "What Goes": "Was geht",
    "What Stays": "Was bleibt",
    "What becomes of the splats in it": "Was aus den Splats darin wird",
    "What counts as a floater": "Was als schwebend gilt",
    "What counts as the distance between a splat and a view": (
        "Was als Abstand zwischen Splat und Ansicht gilt"
    ),
    "What is added": "Was hinzugefügt wird",
    "What is done to the marks": "Was mit den Markierungen geschieht",
    "What is drawn": "Was gezeichnet wird",
    "What is made of each splat": "Was aus jedem Splat wird",
    "What says how much is removed": "Was sagt, wie viel entfernt wird",
    "What the points show": "Was die Punkte zeigen",
    "Which cameras decide": "Welche Kameras entscheiden",
    "Write the active object's splats to a file, in the format that its suffix names": (
        "Die Splats des aktiven Objekts in eine Datei schreiben, im Format, das ihre Endung nennt"
    ),
    (
        "Write the splats as they stand in the world: positions, rotations, scales and "
        "view-dependent colour follow the object"
    ): (
        "Die Splats schreiben, wie sie in der Welt stehen: Orte, Drehungen, Größen und "
        "blickabhängige Farbe folgen dem Objekt"
    ),
    "dB": "dB",
}
"""What is shown in English -> in German."""

_NAME = __package__


def register() -> None:
    """Tell Blender the translations; a label is looked up in the context of what shows it."""
    contexts = ("*", "Operator")
    german = {(context, text): GERMAN[text] for context in contexts for text in GERMAN}
    bpy.app.translations.register(_NAME, {"de_DE": german})


def unregister() -> None:
    """Undo `register`."""
    bpy.app.translations.unregister(_NAME)

"""How large things of AI2-THOR's types are: where a house's own table of assets is not at hand."""

from __future__ import annotations

# Medians of the bounding boxes in procthor 0.0.1.dev2 (allenai/procthor, Apache-2.0): width,
# height, depth [m].
_TABLE = (
    'AlarmClock .19 .18 .09; AluminumFoil .24 .04 .06; Apple .10 .12 .10; ArmChair .94 .88 .89; '
    'BaseballBat .08 .96 .09; BasketBall .24 .24 .24; Bed 1.37 .91 2.24; Book .22 .03 .27; Boots '
    '.28 .52 .22; Bottle .11 .25 .11; Bowl .20 .09 .20; Box .40 .28 .41; Bread .16 .14 .29; '
    'ButterKnife .01 .03 .26; CD .10 .01 .10; Candle .05 .17 .05; Cart .71 1.28 .54; CellPhone '
    '.08 .01 .15; Chair .48 .88 .54; Cloth .21 .02 .18; ClothesDryer .68 1.05 .69; CoffeeMachine '
    '.44 .44 .44; CoffeeTable 1.13 .44 .66; CounterTop 2.44 .94 1.83; CreditCard .09 .01 .05; Cup '
    '.11 .15 .11; Desk 1.39 .79 .62; DeskLamp .26 .46 .29; Desktop .88 .57 .25; DiningTable 1.47 '
    '.76 .96; DishSponge .07 .03 .14; DogBed .99 .18 .83; Dresser 1.20 .97 .51; Dumbbell .13 .13 '
    '.33; Egg .05 .08 .05; Faucet .27 .22 .25; FloorLamp .52 1.87 .51; Footstool .32 .43 .28; '
    'Fork .03 .03 .23; Fridge 1.00 1.84 .72; GarbageBag .51 .56 .52; GarbageCan .45 .56 .37; '
    'HandTowel .13 .40 .04; HandTowelHolder .17 .21 .05; HousePlant .36 .65 .39; Kettle .20 .19 '
    '.21; KeyChain .13 .01 .07; Knife .01 .05 .33; Ladle .08 .05 .29; Laptop .40 .29 .30; '
    'LaundryHamper .55 .74 .43; Lettuce .15 .15 .24; LightSwitch .13 .15 .03; Microwave .61 .35 '
    '.36; Mug .13 .10 .09; Newspaper .33 .03 .13; Ottoman .85 .43 .52; Painting .81 .61 .03; Pan '
    '.28 .05 .43; PaperTowelRoll .08 .21 .06; Pen .01 .01 .20; Pencil .01 .01 .18; PepperShaker '
    '.07 .11 .07; Pillow .43 .14 .35; Plate .24 .02 .24; Plunger .15 .54 .15; Pot .29 .16 .31; '
    'Potato .08 .08 .12; RemoteControl .06 .02 .21; RoomDecor .30 1.34 .37; Safe .40 .40 .45; '
    'SaltShaker .07 .11 .07; ScrubBrush .13 .48 .13; ShelvingUnit .91 1.44 .34; ShowerCurtain .34 '
    '1.66 .33; ShowerHead .23 1.41 .25; SideTable .62 .66 .39; Sink .66 .15 .46; SoapBar .05 .02 '
    '.09; SoapBottle .12 .24 .10; Sofa 2.40 .92 .93; Spatula .06 .02 .30; Spoon .04 .02 .21; '
    'SprayBottle .03 .25 .11; Statue .19 .35 .15; Stool .41 .67 .32; TVStand 1.20 .71 .60; '
    'TableTopDecor .40 .14 .31; TeddyBear .47 .47 .33; Television 1.14 .81 .31; TennisRacket .26 '
    '.04 .65; TissueBox .20 .15 .10; Toaster .22 .21 .36; Toilet .53 .99 .92; ToiletPaper .07 .12 '
    '.07; ToiletPaperHanger .23 .08 .10; Tomato .12 .10 .13; Towel .41 .59 .04; TowelHolder .66 '
    '.04 .11; VacuumCleaner .36 1.01 .31; Vase .18 .21 .17; WashingMachine .68 1.05 .69; Watch '
    '.08 .04 .05; WateringCan .15 .19 .27; WineBottle .09 .33 .09 ')
SIZES: dict[str, tuple[float, float, float]] = {}
for _row in _TABLE.split(';'):
    _name, *_numbers = _row.split()
    SIZES[_name] = (float(_numbers[0]), float(_numbers[1]), float(_numbers[2]))
UNKNOWN = (0.3, 0.3, 0.3)  # m, of another type
